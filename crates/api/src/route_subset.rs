//! ROUTES_SUBSET of one pair as a host writes it: `first-last`.

use std::borrow::Cow;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Serialize};

use super::route_slice::{NotASlice, RouteSlice};

/// An entry of `carla.routeSubsets`, such as `5-9`.
#[derive(Serialize, Deserialize, Clone, Copy, Debug, PartialEq, Eq)]
#[serde(try_from = "String", into = "String")]
pub struct RouteSubset(pub RouteSlice);

impl TryFrom<String> for RouteSubset {
    type Error = NotASlice;

    fn try_from(text: String) -> Result<Self, NotASlice> {
        text.parse().map(Self)
    }
}

impl From<RouteSubset> for String {
    fn from(subset: RouteSubset) -> Self {
        subset.0.to_string()
    }
}

impl JsonSchema for RouteSubset {
    fn schema_name() -> Cow<'static, str> {
        "RouteSubset".into()
    }

    fn inline_schema() -> bool {
        true
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "string", "maxLength": 16, "pattern": "^[0-9]{1,5}-[0-9]{1,5}$" })
    }
}
