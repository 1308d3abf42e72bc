//! A taint of the nodes, as kubectl writes it, and the toleration that the tracks get for it. Pure.

use std::str::FromStr;

use serde_json::{Value, json};

/// `nvidia.com/gpu:NoSchedule`, or with a value `nvidia.com/gpu=true:NoSchedule`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Taint {
    key: String,
    value: Option<String>,
    effect: Effect,
}

#[derive(clap::ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
#[value(rename_all = "PascalCase")]
enum Effect {
    NoSchedule,
    PreferNoSchedule,
    NoExecute,
}

/// Why a text is no taint.
#[derive(thiserror::Error, Debug, PartialEq, Eq)]
#[error(
    "{0:?} is no taint: write KEY:EFFECT or KEY=VALUE:EFFECT, with the effect NoSchedule, PreferNoSchedule or NoExecute"
)]
pub(super) struct NotATaint(String);

impl FromStr for Taint {
    type Err = NotATaint;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let refused = || NotATaint(text.to_owned());
        let (taint, effect) = text.rsplit_once(':').ok_or_else(refused)?;
        let effect = clap::ValueEnum::from_str(effect, false).map_err(|_| refused())?;
        let (key, value) = taint
            .split_once('=')
            .map_or((taint, None), |(key, value)| (key, Some(value)));
        let is_word = |text: &str| {
            text.bytes()
                .all(|byte| byte.is_ascii_alphanumeric() || b"-_./".contains(&byte))
        };
        if key.is_empty() || !is_word(key) || !value.is_none_or(is_word) {
            return Err(refused());
        }
        Ok(Self {
            key: key.to_owned(),
            value: value.map(str::to_owned),
            effect,
        })
    }
}

impl Taint {
    pub(super) fn toleration(&self) -> Value {
        let effect = format!("{:?}", self.effect);
        match &self.value {
            None => json!({"key": self.key, "operator": "Exists", "effect": effect}),
            Some(value) => json!({"key": self.key, "operator": "Equal", "value": value, "effect": effect}),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_taint_is_tolerated_as_it_is_written() {
        let toleration = |text: &str| text.parse::<Taint>().map(|taint| taint.toleration());
        for (text, wanted) in [
            (
                "nvidia.com/gpu:NoSchedule",
                json!({"key": "nvidia.com/gpu", "operator": "Exists", "effect": "NoSchedule"}),
            ),
            (
                "carla=true:NoExecute",
                json!({"key": "carla", "operator": "Equal", "value": "true", "effect": "NoExecute"}),
            ),
        ] {
            assert_eq!(toleration(text), Ok(wanted), "{text}");
        }
        for text in [
            "",
            "nvidia.com/gpu",
            "nvidia.com/gpu=true",
            ":NoSchedule",
            "=true:NoSchedule",
            "a:noschedule",
            "a b:NoSchedule",
            "a=b c:NoSchedule",
        ] {
            assert_eq!(toleration(text), Err(NotATaint(text.to_owned())), "{text}");
        }
    }
}
