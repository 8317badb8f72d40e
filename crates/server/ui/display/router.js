// The route of the page in the address bar, `#/robots/atlas/logs?level=warn`, so that it can be
// shared and bookmarked.

/** The current route: `path`, a list of segments, and `query`, an object of strings. */
export function currentRoute() {
  const [path, query] = location.hash.replace(/^#\/?/, '').split('?');
  return {
    path: path.split('/').filter(Boolean).map(decoded),
    query: Object.fromEntries(new URLSearchParams(query)),
  };
}

function decoded(part) {
  try {
    return decodeURIComponent(part);
  } catch {
    return part;
  }
}

/** The address of a route. Empty values in `query` are left out. */
export function hrefTo(path, query = {}) {
  const given = Object.entries(query).filter(
    ([, value]) => value !== undefined && value !== null && value !== '',
  );
  const text = new URLSearchParams(given).toString();
  return `#/${path.map(encodeURIComponent).join('/')}${text ? `?${text}` : ''}`;
}

/** Navigates to a route, as a new history entry. */
export function navigate(path, query) {
  location.hash = hrefTo(path, query);
}

/** Replaces the query of the current route, without a new history entry. */
export function replaceQuery(query) {
  history.replaceState(null, '', hrefTo(currentRoute().path, query));
}
