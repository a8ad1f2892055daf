// What the page asks of the service: requests, events, and values that are asked for again and again.
import {useCallback, useEffect, useRef, useState} from "./vendor/preact-htm.js";

/** A refusal in words. `status` 0: the service did not answer at all. */
export class Problem extends Error {
  constructor(status, document) {
    super(document.detail || document.title || `The service answered ${status}.`);
    this.status = status;
    this.code = (document.type || "").split("/").at(-1);
    this.document = document;
  }
}

const UNREACHABLE = {title: "No answer", detail: "The service does not answer. Is it running, and the network up? The page tries again by itself."};
const watchers = new Set();
const readers = new Set();
let over = false;

/** Have `told` called with every problem that concerns the page as a whole: a session that is over, a lost service. */
export function watchProblems(told) {
  watchers.add(told);
  return () => watchers.delete(told);
}

/** Somebody was let in: ask again for all that is shown. */
export function entered() {
  over = false;
  for (const again of readers) again();
}

function tell(problem) {
  over ||= problem?.status === 401;
  for (const told of watchers) told(problem);
}

/** Send a request and return what was answered: JSON as a value, or null. `file` is sent as it is. Throws Problem. */
export async function ask(method, path, {body, file, headers} = {}) {
  const sent = body === undefined ? {} : {"Content-Type": "application/json"};
  let response;
  try {
    response = await fetch(path, {
      method, headers: {...sent, ...headers}, body: body === undefined ? file : JSON.stringify(body),
    });
  } catch {
    const problem = new Problem(0, UNREACHABLE);
    tell(problem);
    throw problem;
  }
  // An answer without content may have a type all the same.
  const isJson = response.status !== 204 && /json/.test(response.headers.get("Content-Type") || "");
  const answered = isJson ? await response.json() : null;
  if (response.ok) {
    tell(null);
    return answered;
  }
  const problem = new Problem(response.status, answered || {});
  if (response.status === 401) tell(problem);
  throw problem;
}

/** A key that lets a request be sent again without being done twice. */
export const once = () => ({"Idempotency-Key": crypto.randomUUID()});

/**
 * Follow the events of a job or a calibration. `told(kind, data)` gets each; `ended()` is called when no more will come.
 * Returns what ends it. A browser that loses the service goes on with the event after the last one it saw.
 */
export function follow(path, told, ended = () => {}) {
  const source = new EventSource(path);
  for (const kind of ["progress", "captured", "file", "state", "pose"])
    source.addEventListener(kind, (event) => told(kind, JSON.parse(event.data)));
  source.onerror = () => {
    // Closed by the answer "nothing more will happen", or by a refusal; otherwise the browser tries again.
    if (source.readyState === EventSource.CLOSED) ended();
  };
  return () => source.close();
}

/**
 * A value of the service, asked for now and every `every_s` seconds while the page is looked at.
 * Returns [value, problem, again]; `again()` asks at once. `path` null asks for nothing.
 */
export function useValue(path, every_s = 0) {
  const [found, setFound] = useState({path, value: null, problem: null});
  const wanted = useRef(path);
  wanted.current = path;
  const again = useCallback(async () => {
    if (path === null) return;
    try {
      const value = await ask("GET", path);
      if (wanted.current === path) setFound({path, value, problem: null});
    } catch (problem) {
      if (wanted.current === path) setFound((before) => ({path, value: before.path === path ? before.value : null, problem}));
    }
  }, [path]);
  useEffect(() => {
    let timer = 0;
    let ended = false;
    const turn = async () => {
      if (!document.hidden && !over) await again();
      if (every_s && !ended) timer = setTimeout(turn, every_s * 1000);
    };
    turn();
    readers.add(again);
    return () => {
      ended = true;
      readers.delete(again);
      clearTimeout(timer);
    };
  }, [again, every_s]);
  const current = found.path === path;
  return [current ? found.value : null, current ? found.problem : null, again];
}

/** An action that somebody starts: [start, busy, problem]. `start(...)` returns what the action returns, or undefined. */
export function useAction(action) {
  const [state, setState] = useState({busy: false, problem: null});
  const start = async (...given) => {
    setState({busy: true, problem: null});
    try {
      const result = await action(...given);
      setState({busy: false, problem: null});
      return result;
    } catch (problem) {
      setState({busy: false, problem});
      return undefined;
    }
  };
  return [start, state.busy, state.problem];
}
