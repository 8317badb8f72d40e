// Owns the page of the API documentation; it shares no module with the main page.
//
// Its calls are made as the signed-in user, by the session cookie, or with a given token.

const dark = matchMedia('(prefers-color-scheme: dark)');
const follow = () => document.documentElement.classList.toggle('dark-mode', dark.matches);
dark.addEventListener('change', follow);
follow();

window.SwaggerUIBundle({
  url: '/api/openapi.json',
  dom_id: '#docs',
  deepLinking: true,
  docExpansion: 'none',
  defaultModelsExpandDepth: 0,
  // No external validator.
  validatorUrl: null,
});
