// One stream of server-sent events, kept alive: it reads, notices silence, and connects again with
// growing pauses. It is read with fetch and not with EventSource, which hides keep-alives and the
// status of a refusal.

const URL_OF_EVENTS = '/api/v1/events';
// The server says something at least every 15 s.
const SILENCE_MS = 40_000;
const FIRST_PAUSE_MS = 1_000;
const LONGEST_PAUSE_MS = 20_000;
// A line that never ends is not the server's.
const LONGEST_LINE = 16 * 1024 * 1024;

/**
 * Opens the stream. `tell` gets `{events: [...]}` and `{state}`, one of `open`, `waiting` (with
 * `retry_at` and, where the server refused, its words as `problem`) and `signed_out`, after which
 * nothing follows. Returns a function that ends it. `url` is whose events: all there are, or a
 * robot's lines.
 */
export function openStream(tell, url = URL_OF_EVENTS) {
  const end = new AbortController();
  follow(tell, url, end.signal);
  return () => end.abort();
}

async function follow(tell, url, end) {
  let pause = FIRST_PAUSE_MS;
  while (!end.aborted) {
    let wasOpen = false;
    const opened = () => {
      wasOpen = true;
      tell({ state: 'open' });
    };
    const { status, problem } = await read(tell, url, opened, end);
    if (end.aborted) return;
    if (status === 401) return tell({ state: 'signed_out' });
    pause = wasOpen ? FIRST_PAUSE_MS : Math.min(pause * 2, LONGEST_PAUSE_MS);
    // Spread out, so that a restarted server is not met by every page at once.
    const wait = pause * (0.5 + Math.random() / 2);
    tell({ state: 'waiting', retry_at: Date.now() + wait, problem });
    await rest(wait, end);
  }
}

/** Waits that long, or until the end. */
const rest = (ms, end) =>
  new Promise((resume) => {
    const done = () => {
      clearTimeout(timer);
      end.removeEventListener('abort', done);
      resume();
    };
    const timer = setTimeout(done, ms);
    end.addEventListener('abort', done);
  });

/**
 * Reads one connection to its end. Answers the HTTP status, if there was one, and why the server
 * refused, if it did.
 */
async function read(tell, url, opened, end) {
  const silence = new AbortController();
  let watchdog = setTimeout(() => silence.abort(), SILENCE_MS);
  try {
    const signal = AbortSignal.any([end, silence.signal]);
    const response = await fetch(url, {
      headers: { accept: 'text/event-stream' },
      cache: 'no-store',
      signal,
    });
    if (!response.ok) return { status: response.status, problem: await refusal(response) };
    opened();
    let rest = '';
    for await (const text of chunks(response.body)) {
      clearTimeout(watchdog);
      watchdog = setTimeout(() => silence.abort(), SILENCE_MS);
      const lines = (rest + text).split('\n');
      rest = lines.pop();
      if (rest.length > LONGEST_LINE) throw new Error('the stream is not one of events');
      // Every event of ours is one line of JSON that names its own type; all else is comments and
      // keep-alives.
      const events = lines
        .filter((line) => line.startsWith('data:'))
        .map((line) => JSON.parse(line.slice(5)));
      if (events.length) tell({ events });
    }
    return { status: response.status };
  } catch {
    return {};
  } finally {
    clearTimeout(watchdog);
    silence.abort();
  }
}

/** `503: too many listen`, in the server's words or in those of whatever stands before it. */
async function refusal(response) {
  const said = await response.json().catch(() => null);
  return [response.status, said?.error?.message ?? response.statusText].filter(Boolean).join(': ');
}

async function* chunks(body) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    yield value;
  }
}
