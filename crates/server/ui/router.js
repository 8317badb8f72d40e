// Where in the page somebody is: the address bar's `#/robots/atlas/logs?level=warn`, so that it can
// be shared, kept and gone back from.

/** The place: `path`, its parts, and `query`, a plain object of texts. */
export function place() {
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

/** The address of a place. What is empty or absent in `query` is left out. */
export function at(path, query = {}) {
  const given = Object.entries(query).filter(
    ([, value]) => value !== undefined && value !== null && value !== '',
  );
  const text = new URLSearchParams(given).toString();
  return `#/${path.map(encodeURIComponent).join('/')}${text ? `?${text}` : ''}`;
}

/** Goes there; going back leads here again. */
export function go(path, query) {
  location.hash = at(path, query);
}

/** Says what this place is now: a search, an order. Going back does not undo it. */
export function restate(query) {
  history.replaceState(null, '', at(place().path, query));
}
