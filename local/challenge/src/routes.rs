//! Which routes a worker runs: the ids in a routes file, and the slice of them that `--routes-subset` names. Called by
//! `evaluator`; pure.

/// Why a subset names no routes.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum SubsetError {
    #[error("Couldn't find the route '{0}' inside the given routes file")]
    NoRoute(String),
    #[error("Found a repeated route with id '{0}'")]
    Repeated(String),
}

/// The id of each `<route … id="…">` in the file's order. Looks at nothing else, so it reads both versions' files.
pub fn ids(xml: &str) -> Vec<String> {
    let plain = without_comments(xml);
    let mut found = Vec::new();
    for tag in plain.split('<').skip(1) {
        let Some(attributes) = tag
            .strip_prefix("route")
            .filter(|rest| rest.starts_with(char::is_whitespace))
        else {
            continue;
        };
        let attributes = attributes.split('>').next().unwrap_or_default();
        found.extend(attribute(attributes, "id"));
    }
    found
}

fn without_comments(xml: &str) -> String {
    let mut pieces = xml.split("<!--");
    let mut plain = pieces.next().unwrap_or_default().to_owned();
    for piece in pieces {
        plain.push_str(piece.split_once("-->").map_or("", |(_, after)| after));
    }
    plain
}

fn attribute(attributes: &str, name: &str) -> Option<String> {
    let mut rest = attributes;
    while let Some((key, after)) = rest.split_once('=') {
        let after = after.trim_start();
        let quote = after.chars().next().filter(|quote| matches!(quote, '"' | '\''))?;
        let (value, next) = after[1..].split_once(quote)?;
        if key.trim() == name {
            return Some(value.to_owned());
        }
        rest = next;
    }
    None
}

/// The routes of `subset`: comma separated ids and ranges `a-b`, a range in the file's order. Empty means all.
pub fn select(ids: &[String], subset: &str) -> Result<Vec<String>, SubsetError> {
    let subset = subset.replace(' ', "");
    if subset.is_empty() {
        return Ok(ids.to_vec());
    }
    let position = |id: &str| {
        ids.iter()
            .position(|one| one == id)
            .ok_or_else(|| SubsetError::NoRoute(id.to_owned()))
    };
    let mut chosen: Vec<String> = Vec::new();
    for group in subset.split(',') {
        let (first, last) = group.split_once('-').unwrap_or((group, group));
        let (first_at, last_at) = (position(first)?, position(last)?);
        let range = ids
            .get(first_at..=last_at)
            .ok_or_else(|| SubsetError::NoRoute(last.to_owned()))?;
        for id in range {
            if chosen.contains(id) {
                return Err(SubsetError::Repeated(id.clone()));
            }
            chosen.push(id.clone());
        }
    }
    Ok(chosen)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_ids_as_people_write_them() {
        let xml = "<?xml version='1.0'?>\n<routes>\n<!-- <route id=\"9\"> -->\n<route id=\"0\" town=\"Town01\">\n\
                   <routed id=\"8\"/><route\n town='T id=7' id = '3'></route></route><waypoint id=\"5\"/></routes>";
        assert_eq!(ids(xml), ["0", "3"]);
        assert_eq!(ids("<route town=\"x\"><route id=\"1"), Vec::<String>::new());
    }

    #[test]
    fn subsets_select_their_routes() {
        let all: Vec<String> = ["4", "2", "0", "1"].map(String::from).to_vec();
        for (subset, expected) in [
            ("", vec!["4", "2", "0", "1"]),
            ("2-1", vec!["2", "0", "1"]),
            ("1, 4-2", vec!["1", "4", "2"]),
            ("0", vec!["0"]),
        ] {
            assert_eq!(select(&all, subset).unwrap(), expected, "{subset}");
        }
        assert_eq!(select(&all, "0-3"), Err(SubsetError::NoRoute("3".into())));
        assert_eq!(select(&all, "1-2"), Err(SubsetError::NoRoute("2".into())));
        assert_eq!(select(&all, "4-0,2"), Err(SubsetError::Repeated("2".into())));
    }
}
