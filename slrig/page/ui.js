// Parts that every screen is made of, and how values are written for people.
import {html, useEffect, useState} from "./vendor/preact-htm.js";

/** Millimetres in the unit that reads best. */
export function length(mm) {
  if (mm === null || mm === undefined || !Number.isFinite(mm)) return "not known";
  return Math.abs(mm) < 0.1 ? `${Number((mm * 1000).toPrecision(3))} µm` : `${Number(mm.toPrecision(4))} mm`;
}

export const count = (value) => (value ?? 0).toLocaleString("en");
export const percent = (share) => `${Number((100 * share).toPrecision(3))} %`;

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
export const JobBadge = ({state}) => html`<${Badge} kind=${KINDS[state] ?? ""}>${state}<//>`;

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
