//! The description of one operation: from the handler's attribute, from the types of its arguments
//! and its answer, and from the table of routes. Answers that all routes of a kind share are
//! described here once.

use std::collections::BTreeMap;

use http::{Method, StatusCode};
use serde_json::json;
use task_proto::api::ErrorBody;
use task_proto::people::roles::Permission;
use utoipa::openapi::extensions::Extensions;
use utoipa::openapi::path::{HttpMethod, Operation, Parameter, ParameterBuilder, ParameterIn};
use utoipa::openapi::request_body::RequestBodyBuilder;
use utoipa::openapi::schema::{AdditionalProperties, SchemaType, Type};
use utoipa::openapi::{
    ContentBuilder, HeaderBuilder, Object, OpenApi, Ref, RefOr, Required, Response,
    ResponseBuilder, Schema, SecurityRequirement,
};
use utoipa::{IntoParams, IntoResponses, PartialSchema as _, ToSchema};

use super::super::Route;
use super::super::auth::Access;

/// The idempotency header of every order.
#[derive(IntoParams)]
#[into_params(parameter_in = Header)]
#[expect(
    dead_code,
    reason = "it is read from the headers, after it is known whether the order is a dry run"
)]
pub(in crate::http) struct OrderKey {
    /// Makes the order safe to retry: the same key returns the same response. 1 to 128 visible
    /// characters. Not needed for a dry run.
    #[param(
        rename = "Idempotency-Key",
        required = false,
        min_length = 1,
        max_length = 128,
        pattern = "^[!-~]+$",
        example = "order-4711"
    )]
    idempotency_key: Option<String>,
}

/// The refusals of an order for the robots that a selector matches.
#[derive(IntoResponses)]
#[expect(dead_code, reason = "the handlers answer with `ApiError`, which describes no status")]
pub(in crate::http) enum OrderRefusals {
    /// `unknown_robots`: the selector names unknown robots.
    #[response(status = 404)]
    UnknownRobots,
    /// `no_robots_match`, or `idempotency_key_reused`: the key was used for another order.
    #[response(status = 409)]
    Conflict,
}

/// The description of an operation, as collected so far.
pub(in crate::http) struct Draft {
    /// The path as documented: a catch-all parameter is written like any other.
    pub(super) path: String,
    pub(super) method: HttpMethod,
    pub(super) operation: Operation,
    /// The components that the operation refers to, by name.
    pub(super) schemas: BTreeMap<String, RefOr<Schema>>,
    /// Parameters of the path that no argument has taken yet.
    path_parameters: std::vec::IntoIter<String>,
}

impl Draft {
    /// The complete description of a route.
    pub(super) fn of(route: &Route) -> Self {
        let path = route.path.replace("{*", "{");
        let names = path.split('/').filter_map(|part| part.strip_prefix('{')?.strip_suffix('}'));
        let path_parameters = names.map(str::to_owned).collect::<Vec<_>>().into_iter();
        let method = match route.method {
            None | Some(Method::GET) => HttpMethod::Get,
            Some(Method::POST) => HttpMethod::Post,
            Some(Method::PUT) => HttpMethod::Put,
            Some(Method::PATCH) => HttpMethod::Patch,
            Some(_) => HttpMethod::Delete,
        };
        let mut draft = Self {
            path,
            method,
            operation: Operation::new(),
            schemas: BTreeMap::new(),
            path_parameters,
        };
        (route.describe)(&mut draft);
        draft.guarded_by(route.access);
        if route.deadline.is_some() && route.access != Access::Anyone {
            draft.refusal(StatusCode::REQUEST_TIMEOUT, "The request took too long.");
        }
        draft.complete_refusals(route.access);
        for parameter in draft.operation.parameters.iter_mut().flatten() {
            if let RefOr::T(parameter) = parameter {
                parameter.schema = parameter.schema.take().map(without_null);
            }
        }
        draft
    }

    /// Begins with the contents of the handler's attribute: a document with this one operation,
    /// whose method and path are placeholders.
    pub(in crate::http) fn begin(&mut self, id: &str, attribute: OpenApi) {
        self.operation =
            attribute.paths.paths.into_values().find_map(|item| item.get).unwrap_or_default();
        self.operation.operation_id = Some(id.to_owned());
        self.schemas.extend(attribute.components.unwrap_or_default().schemas);
    }

    /// A reference to a type's schema, which becomes a component.
    fn component<T: ToSchema>(&mut self) -> RefOr<Schema> {
        let mut schemas = Vec::new();
        T::schemas(&mut schemas);
        self.schemas.extend(schemas);
        self.schemas.insert(T::name().into_owned(), T::schema());
        Ref::from_schema_name(T::name()).into()
    }

    /// Documents a JSON body. If unknown fields are refused, the description says so.
    pub(super) fn takes_json<T: ToSchema>(&mut self, is_closed: bool) {
        let schema = self.component::<T>();
        if let Some(RefOr::T(Schema::Object(object))) = self.schemas.get_mut(T::name().as_ref())
            && is_closed
        {
            object.additional_properties = Some(Box::new(AdditionalProperties::FreeForm(false)));
        }
        let content = ContentBuilder::new().schema(Some(schema)).build();
        let body = RequestBodyBuilder::new()
            .content("application/json", content)
            .required(Some(Required::True));
        self.operation.request_body = Some(RefOr::T(body.build()));
        self.refusal(
            StatusCode::BAD_REQUEST,
            "The request does not parse; the message names the field.",
        );
        self.refusal(StatusCode::PAYLOAD_TOO_LARGE, "The body is larger than this route allows.");
        self.refusal(StatusCode::UNSUPPORTED_MEDIA_TYPE, "The body is not `application/json`.");
    }

    /// Documents the type of the next path parameter.
    pub(super) fn takes_path<T: ToSchema>(&mut self) {
        let Some(name) = self.path_parameters.next() else { return };
        self.refusal(
            StatusCode::NOT_FOUND,
            "The resource does not exist, or the name is not valid.",
        );
        let mut described = self.operation.parameters.iter().flatten();
        if described.any(|known| matches!(known, RefOr::T(known) if known.name == name)) {
            return;
        }
        let schema = T::schema();
        let text = description(&schema);
        let parameter = ParameterBuilder::new()
            .name(name)
            .parameter_in(ParameterIn::Path)
            .required(Required::True);
        self.add_parameter(parameter.description(text).schema(Some(schema)).build());
    }

    /// Documents the parameters of the query.
    pub(super) fn takes_query<T: IntoParams>(&mut self) {
        for parameter in T::into_params(|| Some(ParameterIn::Query)) {
            self.add_parameter(parameter);
        }
        self.refusal(
            StatusCode::BAD_REQUEST,
            "The request does not parse; the message names the field.",
        );
    }

    fn add_parameter(&mut self, parameter: Parameter) {
        self.operation.parameters.get_or_insert_default().push(RefOr::T(parameter));
    }

    /// Documents a JSON answer of this type.
    pub(super) fn gives_json<T: ToSchema>(&mut self, status: StatusCode) {
        let schema = self.component::<T>();
        let content = ContentBuilder::new().schema(Some(schema)).build();
        let text = self.schemas.get(T::name().as_ref()).and_then(description);
        let response =
            ResponseBuilder::new().description(text.unwrap_or_else(|| status.to_string()));
        self.answer(status, response.content("application/json", content).build());
    }

    /// Documents an answer without a body.
    pub(super) fn gives_nothing(&mut self) {
        self.answer(StatusCode::NO_CONTENT, ResponseBuilder::new().description("Done.").build());
    }

    fn answer(&mut self, status: StatusCode, response: Response) {
        // The attribute's own description is more specific and takes precedence.
        self.operation
            .responses
            .responses
            .entry(status.as_str().to_owned())
            .or_insert(RefOr::T(response));
    }

    /// Documents a further refusal.
    pub(super) fn refusal(&mut self, status: StatusCode, text: &str) {
        self.answer(status, ResponseBuilder::new().description(text).build());
    }

    /// Documents the guard's requirements and its refusals.
    fn guarded_by(&mut self, access: Access) {
        let scheme = |name: &str| SecurityRequirement::new(name, [""; 0]);
        let (who, permission, schemes): (&str, Option<Permission>, &[&str]) = match access {
            Access::Anyone => ("anyone", None, &[]),
            Access::Person(permission) => ("person", Some(permission), &["token", "session"]),
            Access::OwnRobot => ("robot", None, &["token"]),
            Access::Enrollment => ("enrolment", None, &["token"]),
            Access::PersonOrRobot => ("person or robot", None, &["token", "password", "session"]),
            Access::Peer => ("another server of the cluster", None, &[]),
        };
        self.operation.security = Some(schemes.iter().map(|name| scheme(name)).collect());
        let mut extensions = Extensions::from_iter([("x-caller", json!(who))]);
        if let Some(permission) = permission {
            extensions.insert("x-permission".to_owned(), json!(permission));
        }
        self.operation.extensions = Some(extensions);
        let caller = match access {
            Access::Anyone => "Anyone may call this.".to_owned(),
            Access::Person(permission) => format!("Requires the permission `{permission}`."),
            Access::OwnRobot => "Requires the robot's own token.".to_owned(),
            Access::Enrollment => "Requires an enrollment token.".to_owned(),
            Access::PersonOrRobot => {
                "For people and robots, each within their own rights.".to_owned()
            }
            Access::Peer => "For the other servers of the cluster.".to_owned(),
        };
        let description = self.operation.description.take().filter(|text| !text.is_empty());
        self.operation.description =
            Some(description.map_or(caller.clone(), |text| format!("{text}\n\n{caller}")));
        if access == Access::Anyone {
            return;
        }
        self.refusal(
            StatusCode::UNAUTHORIZED,
            "The token is missing, unknown, expired or revoked.",
        );
        self.refusal(
            StatusCode::FORBIDDEN,
            "The caller lacks the permission, or the robot is outside of the caller's scope.",
        );
        self.refusal(
            StatusCode::TOO_MANY_REQUESTS,
            "Too many invalid tokens from this address, or too many requests of this caller.",
        );
        self.refusal(StatusCode::INTERNAL_SERVER_ERROR, "Internal error; see the server's log.");
    }

    /// Adds the API's common error body and its headers to every refusal without a schema of its
    /// own.
    fn complete_refusals(&mut self, access: Access) {
        // The registry's errors follow the OCI specification.
        let error = match access {
            Access::PersonOrRobot => RefOr::T(Schema::Object(Object::new())),
            _ => self.component::<ErrorBody>(),
        };
        for (status, response) in &mut self.operation.responses.responses {
            let RefOr::T(response) = response else { continue };
            if !status.starts_with(['4', '5']) {
                continue;
            }
            if response.content.is_empty() {
                let content = ContentBuilder::new().schema(Some(error.clone())).build();
                response.content.insert("application/json".to_owned(), RefOr::T(content));
            }
            if matches!(status.as_str(), "429" | "503") {
                let header = HeaderBuilder::new()
                    .schema(Some(u64::schema()))
                    .description(Some("Seconds until a retry is useful."));
                response.headers.insert("Retry-After".to_owned(), RefOr::T(header.build()));
            }
        }
    }
}

/// A type's own description, without the route that the text may name first.
fn description(schema: &RefOr<Schema>) -> Option<String> {
    let RefOr::T(Schema::Object(object)) = schema else { return None };
    let text = object.description.as_deref()?;
    let text = match text.strip_prefix("`GET ").and_then(|text| text.split_once("): ")) {
        Some((_, text)) => text,
        None => text,
    };
    Some(text.replace('\n', " "))
}

/// Removes null from a parameter's schema: an absent parameter is left out, and null can't be
/// written.
fn without_null(schema: RefOr<Schema>) -> RefOr<Schema> {
    let is_null = |item: &RefOr<Schema>| matches!(item, RefOr::T(Schema::Object(object)) if matches!(object.schema_type, SchemaType::Type(Type::Null)));
    match schema {
        RefOr::T(Schema::OneOf(mut one)) => {
            one.items.retain(|item| !is_null(item));
            if one.items.len() == 1 { one.items.remove(0) } else { RefOr::T(Schema::OneOf(one)) }
        }
        RefOr::T(Schema::Object(mut object)) => {
            if let SchemaType::Array(types) = &mut object.schema_type {
                types.retain(|one| *one != Type::Null);
                if let [only] = &types[..] {
                    object.schema_type = SchemaType::Type(only.clone());
                }
            }
            RefOr::T(Schema::Object(object))
        }
        other => other,
    }
}
