//! Parameters of nodes: list, get and set, by the services that every node has unless they were
//! disabled.

use std::time::Duration;

use ros2_client::parameters::raw;
use ros2_client::rcl_interfaces::{
    GetParametersRequest, GetParametersResponse, ListParametersRequest, ListParametersResponse,
    SetParametersRequest, SetParametersResponse,
};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::{Number, Value};
use task_proto::telemetry::ros::GraphName;

use super::services::{Clients, Repeat};
use crate::ros::graph::{GraphError, service_of};

/// Maximum number of parameters of one node that are read or set at once.
pub const MAX_PARAMETERS: usize = 4096;
/// Number of parameters per request.
const BATCH: usize = 128;

const LIST: (&str, &str) = ("list_parameters", "rcl_interfaces/srv/ListParameters");
const GET: (&str, &str) = ("get_parameters", "rcl_interfaces/srv/GetParameters");
const SET: (&str, &str) = ("set_parameters", "rcl_interfaces/srv/SetParameters");

/// A parameter's value, as in `rcl_interfaces/msg/ParameterValue`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ParameterValue {
    /// A parameter declared without a value, or not declared.
    NotSet,
    Bool(bool),
    Integer(i64),
    Double(#[serde(with = "double")] f64),
    String(String),
    Bytes(Vec<u8>),
    Bools(Vec<bool>),
    Integers(Vec<i64>),
    Doubles(#[serde(with = "doubles")] Vec<f64>),
    Strings(Vec<String>),
}

/// Result of setting one parameter.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SetResult {
    pub name: String,
    /// Whether the parameter has the new value.
    pub successful: bool,
    /// The node's reason for a rejection.
    pub reason: String,
}

/// Creates the clients for this node, before the node exists.
pub(in crate::ros::graph) async fn prepare(
    clients: &Clients,
    node: &GraphName,
) -> Result<(), GraphError> {
    for (name, kind) in [LIST, GET, SET] {
        clients.prepare(&service_of(node, name)?, kind).await?;
    }
    Ok(())
}

/// The names of the node's parameters.
pub(in crate::ros::graph) async fn list(
    clients: &Clients,
    node: &GraphName,
    within: Duration,
) -> Result<Vec<String>, GraphError> {
    let request = ListParametersRequest { prefixes: Vec::new(), depth: 0 };
    let service = service_of(node, LIST.0)?;
    let answer: ListParametersResponse =
        clients.call(&service, LIST.1, &request, within, Repeat::UntilDeadline).await?;
    let names = answer.result.names;
    if names.len() > MAX_PARAMETERS {
        return Err(GraphError::TooMany {
            what: "parameters".to_owned(),
            node: node.clone(),
            found: names.len(),
        });
    }
    Ok(names)
}

/// The values of these parameters, in their order.
pub(in crate::ros::graph) async fn get(
    clients: &Clients,
    node: &GraphName,
    names: &[String],
    within: Duration,
) -> Result<Vec<ParameterValue>, GraphError> {
    let service = service_of(node, GET.0)?;
    let mut values = Vec::new();
    for batch in names.chunks(BATCH) {
        let request = GetParametersRequest { names: batch.to_vec() };
        let answer: GetParametersResponse =
            clients.call(&service, GET.1, &request, within, Repeat::UntilDeadline).await?;
        // A node that does not know one of them may answer with no values at all.
        if answer.values.is_empty() {
            values.extend(batch.iter().map(|_| ParameterValue::NotSet));
        } else if answer.values.len() == batch.len() {
            values.extend(answer.values.into_iter().map(ParameterValue::of_wire));
        } else {
            return Err(GraphError::Malformed { service });
        }
    }
    Ok(values)
}

/// Sets these parameters, each independently; returns the result of each, in their order.
pub(in crate::ros::graph) async fn set(
    clients: &Clients,
    node: &GraphName,
    parameters: Vec<(String, ParameterValue)>,
    within: Duration,
) -> Result<Vec<SetResult>, GraphError> {
    if parameters.len() > MAX_PARAMETERS {
        return Err(GraphError::TooMany {
            what: "parameters".to_owned(),
            node: node.clone(),
            found: parameters.len(),
        });
    }
    let service = service_of(node, SET.0)?;
    let names: Vec<_> = parameters.iter().map(|(name, _)| name.clone()).collect();
    let wire =
        |(name, value): (String, ParameterValue)| raw::Parameter { name, value: value.into_wire() };
    let request = SetParametersRequest { parameter: parameters.into_iter().map(wire).collect() };
    let answer: SetParametersResponse =
        clients.call(&service, SET.1, &request, within, Repeat::UntilDeadline).await?;
    if answer.results.len() != names.len() {
        return Err(GraphError::Malformed { service });
    }
    let result = |(name, result): (String, raw::SetParametersResult)| SetResult {
        name,
        successful: result.successful,
        reason: result.reason,
    };
    Ok(names.into_iter().zip(answer.results).map(result).collect())
}

impl ParameterValue {
    /// The parameter value for a JSON value; `None`: no parameter can have this value.
    pub fn from_json(value: &Value) -> Option<Self> {
        let number = |number: &Number| match number.as_i64() {
            Some(integer) => Some(Self::Integer(integer)),
            None if number.is_u64() => None,
            None => number.as_f64().map(Self::Double),
        };
        match value {
            Value::Null => Some(Self::NotSet),
            Value::Bool(value) => Some(Self::Bool(*value)),
            Value::Number(value) => number(value),
            Value::String(value) => Some(Self::String(value.clone())),
            Value::Array(values) => Self::from_list(values),
            Value::Object(_) => None,
        }
    }

    fn from_list(values: &[Value]) -> Option<Self> {
        let all_integers = values.iter().map(Value::as_i64).collect::<Option<Vec<_>>>();
        match values.first() {
            // An empty list has no type of its own; `fitting` gives it one.
            None => Some(Self::Strings(Vec::new())),
            Some(Value::Bool(_)) => {
                values.iter().map(Value::as_bool).collect::<Option<_>>().map(Self::Bools)
            }
            Some(Value::Number(_)) => match all_integers {
                Some(integers) => Some(Self::Integers(integers)),
                None => values.iter().map(Value::as_f64).collect::<Option<_>>().map(Self::Doubles),
            },
            Some(Value::String(_)) => {
                let texts = values.iter().map(|value| value.as_str().map(str::to_owned));
                texts.collect::<Option<_>>().map(Self::Strings)
            }
            Some(_) => None,
        }
    }

    /// The same value in the type of `current`, where that type can express it: users write `1` for
    /// a double, and an empty list for any list.
    #[must_use]
    pub fn fitting(self, current: &Self) -> Self {
        #[expect(
            clippy::cast_precision_loss,
            reason = "an integer of this size stands for an approximate double"
        )]
        let double = |integer: i64| integer as f64;
        match (self, current) {
            (Self::Integer(value), Self::Double(_)) => Self::Double(double(value)),
            (Self::Integers(values), Self::Doubles(_)) => {
                Self::Doubles(values.into_iter().map(double).collect())
            }
            (Self::Integers(values), Self::Bytes(_)) => {
                match values.iter().map(|value| u8::try_from(*value)).collect() {
                    Ok(bytes) => Self::Bytes(bytes),
                    Err(_) => Self::Integers(values),
                }
            }
            (Self::Strings(values), other) if values.is_empty() => match other {
                Self::Bytes(_) => Self::Bytes(Vec::new()),
                Self::Bools(_) => Self::Bools(Vec::new()),
                Self::Integers(_) => Self::Integers(Vec::new()),
                Self::Doubles(_) => Self::Doubles(Vec::new()),
                _ => Self::Strings(values),
            },
            (value, _) => value,
        }
    }

    /// The value in JSON for users. Numbers that JSON does not have become strings.
    pub fn to_json(&self) -> Value {
        let double = |value: &f64| {
            Number::from_f64(*value).map_or_else(|| Value::from(value.to_string()), Value::from)
        };
        match self {
            Self::NotSet => Value::Null,
            Self::Bool(value) => Value::from(*value),
            Self::Integer(value) => Value::from(*value),
            Self::Double(value) => double(value),
            Self::String(value) => Value::from(value.clone()),
            Self::Bytes(values) => Value::from(values.clone()),
            Self::Bools(values) => Value::from(values.clone()),
            Self::Integers(values) => Value::from(values.clone()),
            Self::Doubles(values) => values.iter().map(double).collect(),
            Self::Strings(values) => Value::from(values.clone()),
        }
    }

    fn of_wire(wire: raw::ParameterValue) -> Self {
        match wire.ptype {
            raw::ParameterType::BOOL => Self::Bool(wire.boolean_value),
            raw::ParameterType::INTEGER => Self::Integer(wire.int_value),
            raw::ParameterType::DOUBLE => Self::Double(wire.double_value),
            raw::ParameterType::STRING => Self::String(wire.string_value),
            raw::ParameterType::BYTE_ARRAY => Self::Bytes(wire.byte_array),
            raw::ParameterType::BOOL_ARRAY => Self::Bools(wire.bool_array),
            raw::ParameterType::INTEGER_ARRAY => Self::Integers(wire.int_array),
            raw::ParameterType::DOUBLE_ARRAY => Self::Doubles(wire.double_array),
            raw::ParameterType::STRING_ARRAY => Self::Strings(wire.string_array),
            _ => Self::NotSet,
        }
    }

    fn into_wire(self) -> raw::ParameterValue {
        use ros2_client::ParameterValue as Library;
        match self {
            Self::NotSet => Library::NotSet,
            Self::Bool(value) => Library::Boolean(value),
            Self::Integer(value) => Library::Integer(value),
            Self::Double(value) => Library::Double(value),
            Self::String(value) => Library::String(value),
            Self::Bytes(values) => Library::ByteArray(values),
            Self::Bools(values) => Library::BooleanArray(values),
            Self::Integers(values) => Library::IntegerArray(values),
            Self::Doubles(values) => Library::DoubleArray(values),
            Self::Strings(values) => Library::StringArray(values),
        }
        .into()
    }
}

/// A number in JSON, or a text where JSON has no such number.
#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum JsonDouble {
    Number(f64),
    Text(String),
}

impl JsonDouble {
    fn of(value: f64) -> Self {
        if value.is_finite() { Self::Number(value) } else { Self::Text(value.to_string()) }
    }

    fn read<E: serde::de::Error>(self) -> Result<f64, E> {
        match self {
            Self::Number(value) => Ok(value),
            Self::Text(text) => text.parse().map_err(E::custom),
        }
    }
}

mod double {
    use super::{Deserialize, Deserializer, JsonDouble, Serialize, Serializer};

    pub fn serialize<S: Serializer>(value: &f64, serializer: S) -> Result<S::Ok, S::Error> {
        JsonDouble::of(*value).serialize(serializer)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
        JsonDouble::deserialize(deserializer)?.read()
    }
}

mod doubles {
    use super::{Deserialize, Deserializer, JsonDouble, Serializer};

    pub fn serialize<S: Serializer>(values: &[f64], serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(values.iter().map(|value| JsonDouble::of(*value)))
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<f64>, D::Error> {
        Vec::<JsonDouble>::deserialize(deserializer)?.into_iter().map(JsonDouble::read).collect()
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn values_read_as_they_were_written() {
        for value in [
            json!(null),
            json!(true),
            json!(3),
            json!(2.5),
            json!("a"),
            json!([1, 2]),
            json!([1.5]),
            json!(["a"]),
        ] {
            let parameter = ParameterValue::from_json(&value).expect("a value");
            assert_eq!(parameter.to_json(), value);
            assert_eq!(ParameterValue::of_wire(parameter.clone().into_wire()), parameter);
        }
        for value in [json!({}), json!([1, "a"]), json!([[1]]), json!([true, 1]), json!(u64::MAX)] {
            assert_eq!(ParameterValue::from_json(&value), None, "{value}");
        }
        assert_eq!(ParameterValue::Double(f64::NAN).to_json(), json!("NaN"));
    }

    #[test]
    fn value_takes_the_type_of_the_nodes_parameter() {
        let fitting =
            |value, current| ParameterValue::from_json(&value).expect("a value").fitting(&current);
        assert_eq!(fitting(json!(1), ParameterValue::Double(0.5)), ParameterValue::Double(1.0));
        assert_eq!(
            fitting(json!([1, 2]), ParameterValue::Doubles(vec![])),
            ParameterValue::Doubles(vec![1.0, 2.0])
        );
        assert_eq!(
            fitting(json!([]), ParameterValue::Bools(vec![true])),
            ParameterValue::Bools(vec![])
        );
        assert_eq!(
            fitting(json!([1, 255]), ParameterValue::Bytes(vec![])),
            ParameterValue::Bytes(vec![1, 255])
        );
        assert_eq!(
            fitting(json!([1, 256]), ParameterValue::Bytes(vec![])),
            ParameterValue::Integers(vec![1, 256])
        );
        assert_eq!(
            fitting(json!("a"), ParameterValue::Integer(1)),
            ParameterValue::String("a".into())
        );
    }
}
