// Names of scans and models: the field beside the Scan button, which counts on, and renaming in place.
import {ask, useAction} from "./service.js";
import {Action, Refusal, moment} from "./ui.js";
import {html, useState} from "./vendor/preact-htm.js";

const KEPT = "slrig-name";
const MOST_CHARACTERS = 200;

/** The name after this one: its last number counts on, as in plate-007, plate-008; one without a number gets one. */
export function following(name) {
  const [, stem, digits] = name.trim().match(/^(.*?)(\d*)$/s);
  if (!stem && !digits) return "";
  return digits ? `${stem}${String(BigInt(digits) + 1n).padStart(digits.length, "0")}` : `${stem}-002`;
}

/** What a scan or a model is called: its name, or its time. `kind`: "Scan", "Model". */
export const called = (job, kind = "Scan") => job.label ?? `${kind} of ${moment(job.created_at)}`;

/** The next scan's name, kept by this browser: [name, change, used]. `used()` counts on. */
export function useName() {
  const [name, setName] = useState(() => localStorage.getItem(KEPT) ?? "");
  const change = (next) => {
    localStorage.setItem(KEPT, next);
    setName(next);
  };
  return [name, change, () => change(following(name))];
}

/** Enter in it does what the button beside it does. */
export function NameField({name, change, entered}) {
  return html`<label class="naming">Name <input value=${name} maxlength=${MOST_CHARACTERS} autocomplete="off" placeholder="plate-001" onInput=${(event) => change(event.target.value)}
    onKeyDown=${(event) => event.key === "Enter" && entered()} /></label>`;
}

/** The heading of a scan or a model, which renames it. Children stand behind the name. */
export function NameHeading({job, kind, may, again, children}) {
  const [typed, setTyped] = useState(null);
  const [save, busy, problem] = useAction(async () => {
    await ask("PATCH", job.links.self, {body: {label: typed.trim() || null}});
    setTyped(null);
    await again();
  });
  if (typed === null)
    return html`<h2>${called(job, kind)} ${may && html`<${Action} kind="plain small" onClick=${() => setTyped(job.label ?? "")}>Rename<//>`} ${children}</h2>`;
  const pressed = (event) => {
    if (event.key === "Escape") setTyped(null);
  };
  const submit = (event) => {
    event.preventDefault();
    save();
  };
  return html`<form class="row" onSubmit=${submit} onKeyDown=${pressed}>
    <label>New name <input ref=${(input) => input?.focus()} value=${typed} maxlength=${MOST_CHARACTERS} autocomplete="off" placeholder="No name" onInput=${(event) => setTyped(event.target.value)} /></label>
    <button class="action primary" type="submit" aria-busy=${busy} disabled=${busy}>Save</button><${Action} onClick=${() => setTyped(null)}>Cancel<//>
    <${Refusal} problem=${problem} />
  </form>`;
}
