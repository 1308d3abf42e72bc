//! Numbers as Python has them: whole numbers and floats told apart, rounding and texts digit for digit. Pure arithmetic;
//! statistics and the writers build on it.

use crate::json::Value;

/// Beyond this, whole numbers and floats no longer agree.
const EXACT: i128 = 1 << 53;

/// A number fit for sums. Python's texts differ for `0` and `0.0`, so the kind is kept through additions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Number {
    Int(i128),
    Float(f64),
}

impl Number {
    pub(crate) const ZERO: Self = Self::Int(0);

    /// `None` for what is no number, and for whole numbers a float can't hold.
    pub(crate) fn of(value: &Value) -> Option<Self> {
        match value {
            Value::Int(i) if (-EXACT..=EXACT).contains(i) => Some(Self::Int(*i)),
            Value::Float(f) => Some(Self::Float(*f)),
            _ => None,
        }
    }

    #[expect(
        clippy::cast_precision_loss,
        reason = "Python rounds to the nearest float here as well"
    )]
    pub(crate) fn as_f64(self) -> f64 {
        match self {
            Self::Int(i) => i as f64,
            Self::Float(f) => f,
        }
    }

    pub(crate) fn plus(self, other: Self) -> Self {
        match (self, other) {
            (Self::Int(a), Self::Int(b)) => Self::Int(a.saturating_add(b)),
            (a, b) => Self::Float(a.as_f64() + b.as_f64()),
        }
    }

    pub(crate) fn is_zero(self) -> bool {
        self.as_f64() == 0.0
    }

    /// Python's `round(x, digits)`.
    pub(crate) fn rounded(self, digits: usize) -> Self {
        match self {
            Self::Int(_) => self,
            Self::Float(f) => Self::Float(round(f, digits)),
        }
    }

    /// Python's `str(x)`.
    pub(crate) fn text(self) -> String {
        match self {
            Self::Int(i) => i.to_string(),
            Self::Float(f) => number_text(f),
        }
    }

    /// Python's `'{:.3f}'.format(x)`.
    pub(crate) fn fixed3(self) -> String {
        let x = self.as_f64();
        if x.is_nan() {
            "nan".to_owned()
        } else {
            format!("{x:.3}")
        }
    }
}

/// A small count as a float.
pub(crate) fn count(n: usize) -> f64 {
    u32::try_from(n).map_or(f64::INFINITY, f64::from)
}

/// Python's `round(x, digits)`: to the nearest decimal of the exact binary value.
pub(crate) fn round(x: f64, digits: usize) -> f64 {
    format!("{x:.digits$}").parse().unwrap_or(x)
}

/// Python's `math.pow(x, 2)`; `None` where it raises `OverflowError`.
pub(crate) fn square(x: f64) -> Option<f64> {
    // The original calls the C library, whose pow is not always the correctly rounded x * x (1 in 1,200 differs in the last
    // bit); a constant exponent would be compiled into the multiplication.
    let squared = x.powf(std::hint::black_box(2.0));
    (squared.is_finite() || !x.is_finite()).then_some(squared)
}

/// A float as Python's `repr` writes it: the shortest digits that read back the same, an exponent below 1e-4 and from
/// 1e16 on, `nan` and `inf` in small letters.
pub fn number_text(x: f64) -> String {
    let mut text = String::new();
    push_number(&mut text, x);
    text
}

/// [`number_text`] at the end of another text.
pub(crate) fn push_number(out: &mut String, x: f64) {
    if x.is_nan() {
        return out.push_str("nan");
    }
    if x.is_infinite() {
        return out.push_str(if x > 0.0 { "inf" } else { "-inf" });
    }
    let mut buffer = ryu::Buffer::new();
    let text = buffer.format_finite(x);
    // Where both write no exponent they write the same.
    if x == 0.0 || (1e-4..1e16).contains(&x.abs()) {
        return out.push_str(text);
    }
    let (sign, unsigned) = text.strip_prefix('-').map_or(("", text), |unsigned| ("-", unsigned));
    let (digits, point) = decimal(unsigned);
    out.push_str(sign);
    out.push_str(&layout(&digits, point));
}

/// The digits without leading or trailing zeros, and where the point stands: `0.` digits `* 10^point`.
fn decimal(text: &str) -> (String, i32) {
    let (mantissa, exponent) = text.split_once('e').unwrap_or((text, "0"));
    let (whole, fraction) = mantissa.split_once('.').unwrap_or((mantissa, ""));
    let all = format!("{whole}{fraction}");
    let digits = all.trim_start_matches('0');
    let leading = i32::try_from(all.len().saturating_sub(digits.len())).unwrap_or(0);
    let whole = i32::try_from(whole.len()).unwrap_or(0);
    let point = whole
        .saturating_sub(leading)
        .saturating_add(exponent.parse().unwrap_or(0));
    (digits.trim_end_matches('0').to_owned(), point)
}

/// With an exponent of two digits or more.
fn layout(digits: &str, point: i32) -> String {
    let (first, rest) = digits.split_at_checked(1).unwrap_or(("0", ""));
    let dot = if rest.is_empty() { "" } else { "." };
    let exponent = point.saturating_sub(1);
    let sign = if exponent < 0 { '-' } else { '+' };
    format!("{first}{dot}{rest}e{sign}{:02}", exponent.unsigned_abs())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn texts_are_pythons() {
        for (x, text) in [
            (0.0, "0.0"),
            (-0.0, "-0.0"),
            (1.0, "1.0"),
            (100.0, "100.0"),
            (0.1, "0.1"),
            (0.0001, "0.0001"),
            (0.00001, "1e-05"),
            (1.5e-7, "1.5e-07"),
            (-2.5e-300, "-2.5e-300"),
            (5e-324, "5e-324"),
            (1e15, "1000000000000000.0"),
            (1e16, "1e+16"),
            (1.234_567_890_123_456_8e16, "1.2345678901234568e+16"),
            (1.797_693_134_862_315_7e308, "1.7976931348623157e+308"),
            (0.300_000_000_000_000_04, "0.30000000000000004"),
            (43.13, "43.13"),
            (12345.678, "12345.678"),
            (f64::NAN, "nan"),
            (f64::INFINITY, "inf"),
            (f64::NEG_INFINITY, "-inf"),
        ] {
            assert_eq!(number_text(x), text);
        }
    }

    #[test]
    fn rounding_is_of_the_exact_value() {
        for (x, digits, rounded) in [
            (2.675, 2, 2.67),
            (0.5, 0, 0.0),
            (1.5, 0, 2.0),
            (2.5, 0, 2.0),
            (0.000_000_5, 6, 0.0),
            (1e200, 3, 1e200),
        ] {
            assert_eq!(round(x, digits).to_bits(), f64::to_bits(rounded), "{x}");
        }
        assert!(round(f64::NAN, 3).is_nan());
        assert_eq!(Number::Int(7).rounded(3), Number::Int(7));
    }

    #[test]
    fn whole_numbers_stay_whole_until_a_float_joins() {
        assert_eq!(Number::ZERO.plus(Number::Int(3)).text(), "3");
        assert_eq!(Number::ZERO.plus(Number::Int(3)).plus(Number::Float(0.0)).text(), "3.0");
        assert_eq!(Number::of(&Value::Int(EXACT + 1)), None);
        assert_eq!(Number::Int(0).fixed3(), "0.000");
        assert_eq!(Number::Float(f64::NAN).fixed3(), "nan");
    }

    #[test]
    fn squares_overflow_like_the_original() {
        assert_eq!(square(1e200), None);
        assert_eq!(square(3.0), Some(9.0));
        assert_eq!(square(f64::INFINITY), Some(f64::INFINITY));
    }

    proptest! {
        #[test]
        fn texts_read_back_the_same(bits in any::<u64>(), common in -1e17..1e17_f64, pick in 0..3) {
            let x = match pick {
                0 => f64::from_bits(bits),
                1 => common,
                _ => common / 1e19,
            };
            let bits = x.to_bits();
            prop_assume!(x.is_finite());
            let exponent = format!("{x:e}").split_once('e').map(|(_, exponent)| exponent.parse::<i32>());
            prop_assert_eq!(
                number_text(x).contains('e'),
                x != 0.0 && exponent.is_some_and(|e| e.is_ok_and(|e| !(-4..16).contains(&e)))
            );
            let text = number_text(x);
            prop_assert_eq!(text.parse::<f64>().map(f64::to_bits), Ok(bits));
            prop_assert!(text.contains(['.', 'e']));
        }
    }
}
