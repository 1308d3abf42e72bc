//! Changes that keep JSON what it is: a scalar becomes another one, an object is repeated or taken out. libFuzzer's own
//! changes, of bytes, are used half of the time; alone they rarely get past the reader.

use std::ops::Range;

use libfuzzer_sys::fuzzer_mutate;

const TOKENS: [&str; 28] = [
    "0",
    "1",
    "2",
    "-1",
    "100",
    "1e-7",
    "0.1",
    "1e200",
    "1e999",
    "-1e-320",
    "NaN",
    "-Infinity",
    "9007199254740993",
    "99999999999999999999999999999999999999999999",
    "null",
    "true",
    "[]",
    "{}",
    "\"\"",
    "\"\\ud800\"",
    "\"Crashed\"",
    "\"Failed - Simulation crashed\"",
    "\"Failed - Agent's sensors were invalid\"",
    "\"RouteScenario_1_rep0\"",
    "\"RouteScenario_2\"",
    "\"carla_gnss\"",
    "[\"Agent went outside its route lanes for about 1e3 meters (1% x\"]",
    "[\"Average speed is 250.5% of\"]",
];

/// The new size.
pub fn mutate(data: &mut [u8], size: usize, max_size: usize, seed: u32) -> usize {
    let mut dice = Dice(u64::from(seed) | 1 << 40);
    let changed = match dice.below(6) {
        0 => scalar(&data[..size], &mut dice),
        1 => objects(&data[..size], &mut dice, false),
        2 => objects(&data[..size], &mut dice, true),
        _ => None,
    };
    match changed {
        Some(changed) if changed.len() <= max_size => {
            data[..changed.len()].copy_from_slice(&changed);
            changed.len()
        }
        _ => fuzzer_mutate(data, size, max_size),
    }
}

struct Dice(u64);

impl Dice {
    fn below(&mut self, limit: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        usize::try_from(self.0 >> 20).unwrap_or(0) % limit.max(1)
    }

    fn one<T: Clone>(&mut self, of: &[T]) -> Option<T> {
        of.get(self.below(of.len())).cloned()
    }
}

fn with(data: &[u8], range: Range<usize>, put: &[u8]) -> Vec<u8> {
    [&data[..range.start], put, &data[range.end..]].concat()
}

/// A value behind a colon becomes another one.
fn scalar(data: &[u8], dice: &mut Dice) -> Option<Vec<u8>> {
    let starts: Vec<usize> = (1..data.len()).filter(|i| data[*i - 1] == b':').collect();
    let start = dice.one(&starts)?;
    let rest = &data[start..];
    let length = match rest.first()? {
        b'{' | b'[' => balanced(rest)?,
        b'"' => 2 + rest[1..].iter().position(|byte| *byte == b'"')?,
        _ => rest.iter().position(|byte| b",}]".contains(byte))?,
    };
    Some(with(data, start..start + length, dice.one(&TOKENS)?.as_bytes()))
}

/// An element of a list is there twice, or not at all.
fn objects(data: &[u8], dice: &mut Dice, twice: bool) -> Option<Vec<u8>> {
    let is_first = |i: &usize| data[*i] == b'{' && matches!(data[*i - 1], b',' | b'[');
    let starts: Vec<usize> = (1..data.len()).filter(is_first).collect();
    let start = dice.one(&starts)?;
    let end = start + balanced(&data[start..])?;
    if twice {
        let again = [b",", &data[start..end]].concat();
        return Some(with(data, end..end, &again));
    }
    let comma = usize::from(data.get(end) == Some(&b','));
    Some(with(data, start..end + comma, b""))
}

/// Length of the object or list that begins here, brackets in texts counted as well.
fn balanced(data: &[u8]) -> Option<usize> {
    let mut depth = 0_usize;
    for (i, byte) in data.iter().enumerate() {
        match byte {
            b'{' | b'[' => depth += 1,
            b'}' | b']' => depth = depth.checked_sub(1)?,
            _ => {}
        }
        if depth == 0 {
            return Some(i + 1);
        }
    }
    None
}
