//! The attribute that describes a route's handler in the server's OpenAPI document. It knows
//! neither the handler's method nor its path: the table of routes has them.

use proc_macro::TokenStream;
use proc_macro2::TokenStream as Tokens;
use quote::quote;

/// Describes a handler: its doc comment is the operation's text, the arguments are those of
/// `utoipa::path` without method and path.
///
/// `utoipa::path` does not compile without these two, so it gets placeholders, which the server's
/// `openapi` replaces by the method and the path of the handler's route.
#[proc_macro_attribute]
pub fn operation(arguments: TokenStream, handler: TokenStream) -> TokenStream {
    let (arguments, handler) = (Tokens::from(arguments), Tokens::from(handler));
    quote! {
        #[utoipa::path(get, path = "", #arguments)]
        #handler
    }
    .into()
}
