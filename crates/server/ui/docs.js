// The page of the API's description. What is tried out there is sent as whoever is signed in at the
// page, by its cookie; a token can be given instead.

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
  // Documents are checked by nobody else.
  validatorUrl: null,
});
