//! Rewrites the "expected …" part of parse errors in terms of TOML and JSON. Independent of files
//! and keys.

/// Rewrites a message of serde with the type names of TOML and JSON: `expected a sequence` becomes
/// `expected a list`.
///
/// ```
/// use task_proto::expected::in_file_terms;
/// let text = in_file_terms("invalid type: string \"x\", expected a sequence");
/// assert_eq!(text, "invalid type: string \"x\", expected a list");
/// let text = in_file_terms("invalid type: map, expected u64");
/// assert_eq!(text, "invalid type: table, expected a whole number");
/// ```
pub fn in_file_terms(message: &str) -> String {
    // The given value comes first, in quotes, and may contain any words.
    let (given, expected) = message.rsplit_once(", expected ").unwrap_or((message, ""));
    let given = match given {
        "invalid type: sequence" => "invalid type: list",
        "invalid type: map" => "invalid type: table",
        other => other,
    };
    let expected = match expected {
        "" => return given.to_owned(),
        "a sequence" => "a list",
        "a map" => "a table",
        "a boolean" => "true or false",
        "u8" | "u16" | "u32" | "u64" | "usize" | "i8" | "i16" | "i32" | "i64" => "a whole number",
        "f32" | "f64" => "a number",
        other => other,
    };
    format!("{given}, expected {expected}")
}
