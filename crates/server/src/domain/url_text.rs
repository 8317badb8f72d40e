//! Parts of URLs in settings: lists separated by commas, and percent-encoding. This module knows no
//! scheme.

/// The URLs of a list, without the spaces around them. A password may hold a comma: only a comma
/// that is followed by one of these schemes separates two URLs.
pub(super) fn split<'a>(text: &'a str, schemes: &[&str]) -> Vec<&'a str> {
    let begins_url =
        |text: &str| schemes.iter().any(|scheme| text.trim_start().starts_with(scheme));
    let mut urls = Vec::new();
    let mut begin = 0;
    for (at, _) in text.match_indices(',').filter(|(at, _)| begins_url(&text[at + 1..])) {
        urls.push(text[begin..at].trim());
        begin = at + 1;
    }
    urls.push(text[begin..].trim());
    urls
}

/// Replaces each `%XX` by its byte. `None` if digits are missing or the result is not UTF-8.
pub(super) fn percent_decoded(text: &str) -> Option<String> {
    let mut bytes = Vec::with_capacity(text.len());
    let mut rest = text.as_bytes();
    while let Some((&first, after)) = rest.split_first() {
        if first == b'%' {
            let digits = std::str::from_utf8(after.get(..2)?).ok()?;
            if !digits.bytes().all(|digit| digit.is_ascii_hexdigit()) {
                return None;
            }
            bytes.push(u8::from_str_radix(digits, 16).ok()?);
            rest = &after[2..];
        } else {
            bytes.push(first);
            rest = after;
        }
    }
    String::from_utf8(bytes).ok()
}
