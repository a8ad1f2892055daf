// Parts that every screen is made of, and how values are written for people.
import {html, useEffect, useState} from "./vendor/preact-htm.js";

/** A number for people: a real minus sign, narrow spaces between thousands. `decimals` are always shown; without, `digits` significant ones at most. */
export function number(value, {digits = 3, decimals} = {}) {
  if (!Number.isFinite(value)) return "not known";
  const after = decimals ?? Math.min(Math.max(digits - 1 - Math.floor(Math.log10(Math.abs(value) || 1)), 0), 20);
  const written = value.toLocaleString("en", {minimumFractionDigits: decimals ?? 0, maximumFractionDigits: after});
  return written.replace(/^-(0[.0]*)$/, "$1").replace("-", "−").replaceAll(",", "\u202f");
}

/** A value in the first of its units that leaves it below `most`: `units` is a list of [unit, its size, most]. */
function inUnit(value, units, options) {
  if (!Number.isFinite(value)) return "not known";
  const [unit, size] = units.find(([, , most]) => Math.abs(value) < most) ?? units.at(-1);
  return `${number(value / size, options)}\u00a0${unit}`;
}

/** Millimetres in the unit that reads best; lengths in another `unit` as they are. */
export const length = (mm, unit = "mm") => (unit !== "mm" ? inUnit(mm, [[unit, 1, Infinity]]) : mm === 0 ? "0\u00a0mm" : inUnit(mm, [["µm", 1e-3, 0.1], ["mm", 1, Infinity]], {digits: Math.abs(mm) < 0.1 ? 3 : 4}));
/** Seconds in the unit that reads best. */
export const duration = (s) => inUnit(s, [["µs", 1e-6, 1e-3], ["ms", 1e-3, 1], ["s", 1, 120], ["min", 60, 7200], ["h", 3600, 172800], ["days", 86400, Infinity]], {digits: s < 120 ? 3 : 2});
export const bytes = (amount) => inUnit(amount, [["kB", 1e3, 1e6], ["MB", 1e6, 1e9], ["GB", 1e9, 1e12], ["TB", 1e12, Infinity]], {digits: 2});
export const count = (value) => number(value ?? 0, {decimals: 0});

/** A share of 1 as a percentage; one that is almost none or almost all is not rounded to that. */
export function percent(share) {
  if (share > 0 && share < 1e-4) return "<\u00a00.01\u00a0%";
  if (share > 0.9995 && share < 1) return ">\u00a099.9\u00a0%";
  return Number.isFinite(share) ? `${number(100 * share)}\u00a0%` : "not known";
}

/** Words as the beginning of a sentence. */
export const begun = (words) => words.slice(0, 1).toUpperCase() + words.slice(1);

/** A moment as people say it. */
export function moment(text) {
  if (!text) return "never";
  const then = new Date(text);
  const ago_s = (Date.now() - then) / 1000;
  if (ago_s >= 0 && ago_s < 60) return "just now";
  if (ago_s >= 0 && ago_s < 3600) return `${Math.round(ago_s / 60)} min ago`;
  const today = then.toDateString() === new Date().toDateString();
  return then.toLocaleString("en-GB", today ? {timeStyle: "short"} : {dateStyle: "medium", timeStyle: "short"});
}

/** Why something was refused and what to do, read out by screen readers as it comes. */
export function Refusal({problem, children}) {
  if (!problem) return null;
  const {errors} = problem.document ?? {};
  return html`<div class="refusal" role="alert">
    <strong>${problem.document?.title ?? "Refused"}</strong>
    <p>${problem.message}</p>
    ${errors && html`<ul>${errors.map((each) => html`<li><code>${each.field}</code>: ${each.message}</li>`)}</ul>`}
    ${children}
  </div>`;
}

/** A button that says when it is at work. */
export function Action({busy, children, kind = "", ...given}) {
  return html`<button type="button" ...${given} class=${`action ${kind}`} aria-busy=${busy} disabled=${busy || given.disabled}>
    ${children}
  </button>`;
}

/** How far something is: `fraction` 0 to 1. */
export function Progress({label, fraction, detail}) {
  return html`<div class="progress" role="status">
    <div class="between"><span>${label}</span><span>${percent(Math.round(fraction * 100) / 100)}</span></div>
    <progress max="1" value=${fraction} aria-label=${label}></progress>
    ${detail && html`<p class="quiet">${detail}</p>`}
  </div>`;
}

/** Name and value, one pair a line. Pairs whose value is null or undefined are left out. */
export function Facts({of}) {
  const known = of.filter(([, value]) => value !== null && value !== undefined);
  return html`<dl class="facts">${known.map(([name, value]) => html`<div><dt>${name}</dt><dd>${value}</dd></div>`)}</dl>`;
}

/** A state in a word, coloured. `kind`: good, warn, bad, busy. */
export const Badge = ({kind, children}) => html`<span class=${`badge ${kind}`}>${children}</span>`;

const KINDS = {succeeded: "good", failed: "bad", interrupted: "bad", cancelled: "warn", queued: "busy", capturing: "busy", computing: "busy"};
export const JobBadge = ({state}) => html`<${Badge} kind=${KINDS[state] ?? ""}>${begun(state)}<//>`;

/** Choose one of a few: `options` is a list of [value, words]. */
export function Choice({label, value, options, chosen}) {
  return html`<div class="choice" role="group" aria-label=${label}>
    ${options.map(([each, words]) => html`<button type="button" aria-pressed=${each === value} onClick=${() => chosen(each)}>${words}</button>`)}
  </div>`;
}

/** A number that somebody types. */
export function Field({label, value, change, ...given}) {
  return html`<label>${label}<input type="number" step="any" min="0" value=${value} onInput=${(event) => change(event.target.value)} ...${given} /></label>`;
}

/** A question that stands in the way until it is answered. */
export function Confirm({question, yes, onYes, onNo}) {
  return html`<div class="refusal" role="alertdialog" aria-label=${question}>
    <p>${question}</p>
    <div class="row"><${Action} kind="danger" onClick=${onYes}>${yes}<//><${Action} onClick=${onNo}>Keep it<//></div>
  </div>`;
}

/** The part of the address after #: its words, and the page follows it. */
export function usePlace() {
  const read = () => location.hash.replace(/^#\/?/, "").split("/").filter(Boolean);
  const [place, setPlace] = useState(read);
  useEffect(() => {
    const changed = () => setPlace(read());
    addEventListener("hashchange", changed);
    return () => removeEventListener("hashchange", changed);
  }, []);
  return place;
}
