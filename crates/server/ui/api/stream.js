// A stream of server-sent events that detects silence and reconnects with backoff. It uses fetch,
// since EventSource hides keep-alives and the status of refusals.

const EVENTS_URL = '/api/v1/events';
// The server sends at least a keep-alive every 15 s.
const SILENCE_MS = 40_000;
const FIRST_PAUSE_MS = 1_000;
const MAX_PAUSE_MS = 20_000;
// A limit on malformed streams.
const MAX_LINE_LENGTH = 16 * 1024 * 1024;

/**
 * Opens the stream. `emit` gets `{events: [...]}` and `{state}`, one of `open`, `waiting` (with
 * `retry_at` and, if the server refused, its message as `problem`) and `signed_out`, which is the
 * last message. Returns a function that ends the stream. `url` selects all events or the log lines
 * of a robot.
 */
export function openStream(emit, url = EVENTS_URL) {
  const end = new AbortController();
  follow(emit, url, end.signal);
  return () => end.abort();
}

async function follow(emit, url, end) {
  let backoff = FIRST_PAUSE_MS;
  while (!end.aborted) {
    let wasOpen = false;
    const opened = () => {
      wasOpen = true;
      emit({ state: 'open' });
    };
    const { status, problem } = await read(emit, url, opened, end);
    if (end.aborted) return;
    if (status === 401) return emit({ state: 'signed_out' });
    backoff = wasOpen ? FIRST_PAUSE_MS : Math.min(backoff * 2, MAX_PAUSE_MS);
    // With jitter, so that pages do not all return to a restarted server at once.
    const wait = backoff * (0.5 + Math.random() / 2);
    emit({ state: 'waiting', retry_at: Date.now() + wait, problem });
    await pause(wait, end);
  }
}

/** Waits this long, or until the end. */
const pause = (ms, end) =>
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
 * Reads one connection to its end. Returns the HTTP status, if any, and the message of a refusal.
 */
async function read(emit, url, opened, end) {
  const silence = new AbortController();
  let watchdog = setTimeout(() => silence.abort(), SILENCE_MS);
  try {
    const signal = AbortSignal.any([end, silence.signal]);
    const response = await fetch(url, {
      headers: { accept: 'text/event-stream' },
      cache: 'no-store',
      signal,
    });
    if (!response.ok) return { status: response.status, problem: await errorText(response) };
    opened();
    let rest = '';
    for await (const text of chunks(response.body)) {
      clearTimeout(watchdog);
      watchdog = setTimeout(() => silence.abort(), SILENCE_MS);
      const lines = (rest + text).split('\n');
      rest = lines.pop();
      if (rest.length > MAX_LINE_LENGTH) throw new Error('a line of the event stream is too long');
      // Each event is one line of JSON with its type; all other lines are comments and keep-alives.
      const events = lines
        .filter((line) => line.startsWith('data:'))
        .map((line) => JSON.parse(line.slice(5)));
      if (events.length) emit({ events });
    }
    return { status: response.status };
  } catch {
    return {};
  } finally {
    clearTimeout(watchdog);
    silence.abort();
  }
}

/** `503: too many streams`, from the server or a proxy before it. */
async function errorText(response) {
  const answer = await response.json().catch(() => null);
  return [response.status, answer?.error?.message ?? response.statusText]
    .filter(Boolean)
    .join(': ');
}

async function* chunks(body) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    yield value;
  }
}
