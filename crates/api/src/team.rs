//! The team that submitted: as a spec names it, and as the status shows it.
//!
//! Pure.

use kube::KubeSchema;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::text::{LONGEST_NAME, one_line};

/// Team that submitted.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, Default, PartialEq, Eq)]
#[x_kube(validation = Rule::new("has(self.id) || has(self.name)").message("team needs an id or a name"))]
pub struct Team {
    /// Id in EvalAI, in decimal; any text for a local submission.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 128))]
    pub id: Option<String>,
    /// Name of the team, for people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 256))]
    pub name: Option<String>,
}

/// Who submitted, as it is shown.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, Default, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct TeamStatus {
    /// Id in EvalAI, in decimal; any text for a local submission.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 128))]
    pub id: Option<String>,
    /// Name of the team, for people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 256))]
    pub name: Option<String>,
    /// The name, or else the id, in at most 24 characters: kubectl cuts no column.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 24))]
    pub display_name: Option<String>,
}

impl From<Team> for TeamStatus {
    fn from(team: Team) -> Self {
        let shown = team.name.as_ref().or(team.id.as_ref());
        Self {
            display_name: shown.map(|name| one_line(name, 24)),
            id: team.id.map(|id| one_line(&id, 128)),
            name: team.name.map(|name| one_line(&name, LONGEST_NAME)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_teams_name_is_cut_for_its_column() {
        let shown = |name: &str| {
            let name = Some(name.to_owned());
            TeamStatus::from(Team { id: None, name }).display_name.unwrap()
        };
        assert_eq!(shown("Team Seven"), "Team Seven");
        assert_eq!(shown(&"é".repeat(24)), "é".repeat(24));
        assert_eq!(shown(&"é".repeat(25)), format!("{}…", "é".repeat(23)));
    }
}
