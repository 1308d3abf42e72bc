//! The keys of a table: their names and types, as the table describes them, and values for them. Pure.

use aws_sdk_dynamodb::types::{AttributeValue, KeyType, ScalarAttributeType, TableDescription};

use super::TableError;

/// A key of a table.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Key {
    pub name: String,
    kind: ScalarAttributeType,
}

impl Key {
    pub(super) fn text(name: String) -> Self {
        Self {
            name,
            kind: ScalarAttributeType::S,
        }
    }

    /// A text as the value of this key; what it is, for an error.
    pub(super) fn value(&self, table: &str, text: &str, what: &str) -> Result<AttributeValue, TableError> {
        let problem = if text.is_empty() {
            format!("is empty: the {what} is not known")
        } else {
            match self.kind {
                ScalarAttributeType::S => return Ok(AttributeValue::S(text.to_owned())),
                ScalarAttributeType::N if text.parse::<i64>().is_ok() => return Ok(AttributeValue::N(text.to_owned())),
                ScalarAttributeType::N => format!("is a number in this table, but the {what} is called {text}"),
                _ => "is neither a string nor a number in this table".to_owned(),
            }
        };
        Err(TableError::Key {
            table: table.to_owned(),
            key: self.name.clone(),
            problem,
        })
    }
}

/// The keys as the table describes them.
pub(super) fn read(
    table: &str,
    described: Option<&TableDescription>,
    set: Option<(String, String)>,
) -> Result<(Key, Key), TableError> {
    let find = |kind: KeyType| {
        let schema = described.map(TableDescription::key_schema).unwrap_or_default();
        let name = schema
            .iter()
            .find(|element| *element.key_type() == kind)?
            .attribute_name();
        let types = described
            .map(TableDescription::attribute_definitions)
            .unwrap_or_default();
        let definition = types.iter().find(|definition| definition.attribute_name() == name);
        Some(Key {
            name: name.to_owned(),
            kind: definition.map_or(ScalarAttributeType::S, |d| d.attribute_type().clone()),
        })
    };
    let found = find(KeyType::Hash).zip(find(KeyType::Range));
    let (partition, sort) = found.ok_or_else(|| TableError::NoSortKey {
        table: table.to_owned(),
    })?;
    match set {
        Some((first, second)) if (&first, &second) != (&partition.name, &sort.name) => Err(TableError::OtherKeys {
            table: table.to_owned(),
            found: format!("{} and {}", partition.name, sort.name),
            set: format!("{first} and {second}"),
        }),
        _ => Ok((partition, sort)),
    }
}

#[cfg(test)]
mod tests {
    use aws_sdk_dynamodb::types::{AttributeDefinition, KeySchemaElement};

    use super::*;

    fn described(all: &[(&str, KeyType, ScalarAttributeType)]) -> TableDescription {
        let mut builder = TableDescription::builder();
        for (name, role, kind) in all {
            builder = builder
                .key_schema(
                    KeySchemaElement::builder()
                        .attribute_name(*name)
                        .key_type(role.clone())
                        .build()
                        .unwrap(),
                )
                .attribute_definitions(
                    AttributeDefinition::builder()
                        .attribute_name(*name)
                        .attribute_type(kind.clone())
                        .build()
                        .unwrap(),
                );
        }
        builder.build()
    }

    #[test]
    fn keys_are_those_of_the_table() {
        use {KeyType::Hash, KeyType::Range, ScalarAttributeType as Kind};
        for (team, submission, kind) in [
            ("team_id", "submission_id", Kind::S),
            ("team-id", "submission-id", Kind::N),
        ] {
            // Definitions come in any order and may hold keys of indexes.
            let table = described(&[(submission, Range, kind.clone()), (team, Hash, Kind::S)]);
            let key = |name: &str, kind| Key {
                name: name.into(),
                kind,
            };
            let want = (key(team, Kind::S), key(submission, kind));
            assert_eq!(read("t", Some(&table), None), Ok(want.clone()));
            assert_eq!(
                read("t", Some(&table), Some((team.into(), submission.into()))),
                Ok(want)
            );
        }
        let single = described(&[("team_id", Hash, Kind::S)]);
        assert_eq!(
            read("t", Some(&single), None),
            Err(TableError::NoSortKey { table: "t".into() })
        );
        let table = described(&[("team_id", Hash, Kind::S), ("submission_id", Range, Kind::S)]);
        let other = read("t", Some(&table), Some(("team-id".into(), "submission-id".into()))).unwrap_err();
        assert_eq!(
            other.to_string(),
            "table t has the keys team_id and submission_id but table.dynamoDB.partitionKey and table.dynamoDB.sortKey are team-id and submission-id; leave both out"
        );
    }
}
