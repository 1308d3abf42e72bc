//! A manifest as YAML or JSON, with the line of each value. Pure.

use std::fmt;

use serde::Deserialize;
use serde::de::{Deserializer, MapAccess, SeqAccess, Visitor};
use serde_json::{Map, Value};
use serde_saphyr::{Location, Spanned};

/// A value and its line, from 1.
#[derive(Deserialize, Debug)]
#[serde(transparent)]
pub struct Node(Spanned<Tree>);

#[derive(Debug)]
enum Tree {
    Scalar(Value),
    List(Vec<Node>),
    /// Each key with its own line.
    Map(Vec<(String, u64, Node)>),
}

/// The objects of a file in its order, or the line and the reason why it is no YAML.
pub fn parse(text: &str) -> Result<Vec<Node>, (u64, String)> {
    let documents: Vec<Node> = serde_saphyr::from_multiple(text).map_err(|error| {
        let error = error.without_snippet();
        (error.location().as_ref().map_or(1, Location::line), error.to_string())
    })?;
    Ok(documents.into_iter().flat_map(Node::unlisted).collect())
}

impl Node {
    /// The items of a `List`, as kubectl takes them; else the object itself.
    fn unlisted(self) -> Vec<Self> {
        if self.value()["kind"] != "List" {
            return vec![self];
        }
        let Tree::Map(fields) = self.0.value else {
            return Vec::new();
        };
        let items = fields.into_iter().find(|(key, ..)| key == "items");
        match items.map(|(_, _, node)| node.0.value) {
            Some(Tree::List(items)) => items,
            _ => Vec::new(),
        }
    }

    fn line(&self) -> u64 {
        self.0.referenced.line()
    }

    /// The value without its lines.
    pub fn value(&self) -> Value {
        match &self.0.value {
            Tree::Scalar(value) => value.clone(),
            Tree::List(items) => items.iter().map(Self::value).collect(),
            Tree::Map(fields) => {
                let fields = fields.iter().map(|(key, _, node)| (key.clone(), node.value()));
                Value::Object(fields.collect::<Map<_, _>>())
            }
        }
    }

    /// The line of what a path such as `spec.tracks[0].name` names, or of the nearest that is there.
    pub fn line_of(&self, path: &str) -> u64 {
        let (mut node, mut line) = (self, self.line());
        for step in path.split(['.', '[', ']']).filter(|step| !step.is_empty()) {
            let found = match &node.0.value {
                Tree::Map(fields) => fields.iter().find(|(key, ..)| key == step),
                Tree::List(items) => {
                    let item = step.parse().ok().and_then(|index: usize| items.get(index));
                    let Some(item) = item else { break };
                    (node, line) = (item, item.line());
                    continue;
                }
                Tree::Scalar(_) => None,
            };
            let Some((_, at, inner)) = found else { break };
            (node, line) = (inner, *at);
        }
        line
    }
}

impl<'de> Deserialize<'de> for Tree {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(Values)
    }
}

struct Values;

impl<'de> Visitor<'de> for Values {
    type Value = Tree;

    fn expecting(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("a value")
    }

    fn visit_unit<E>(self) -> Result<Tree, E> {
        Ok(Tree::Scalar(Value::Null))
    }

    fn visit_bool<E>(self, value: bool) -> Result<Tree, E> {
        Ok(Tree::Scalar(value.into()))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Tree, E> {
        Ok(Tree::Scalar(value.into()))
    }

    fn visit_u64<E>(self, value: u64) -> Result<Tree, E> {
        Ok(Tree::Scalar(value.into()))
    }

    fn visit_f64<E>(self, value: f64) -> Result<Tree, E> {
        Ok(Tree::Scalar(value.into()))
    }

    fn visit_str<E>(self, value: &str) -> Result<Tree, E> {
        Ok(Tree::Scalar(value.into()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut access: A) -> Result<Tree, A::Error> {
        let mut items = Vec::new();
        while let Some(item) = access.next_element()? {
            items.push(item);
        }
        Ok(Tree::List(items))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut access: A) -> Result<Tree, A::Error> {
        let mut fields = Vec::new();
        while let Some(key) = access.next_key::<Spanned<String>>()? {
            fields.push((key.value, key.referenced.line(), access.next_value()?));
        }
        Ok(Tree::Map(fields))
    }
}
