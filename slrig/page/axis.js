// The turntable: its axis by a board that stands on it, and the planes that do not belong to an object.
import {html, useEffect, useState} from "./vendor/preact-htm.js";
import {BoardFields, USUAL_BOARD, useBoard} from "./board.js";
import {Running} from "./running.js";
import {ask, once, useAction, useValue} from "./service.js";
import {Action, Badge, Confirm, Facts, Field, Refusal, length, moment} from "./ui.js";

const STATES = {unknown: ["warn", "Not measured"], known: ["good", "Known"], moved: ["bad", "Moved"]};
const PLANES = {plate: "plate", backdrop: "backdrop"};

/** The state of the axis in a word and a sentence. */
function axisWords(table) {
  if (table.own_axis) return ["good", "Known", "The rig states its axis by itself. Measuring it replaces that."];
  const [kind, word] = STATES[table.state];
  const words = {
    unknown: "Stand the board on the turntable and measure it once.", known: "",
    moved: "The last model turned about another axis: was the turntable or a camera moved, or the rig newly calibrated? Then measure the axis again.",
  };
  return [kind, word, words[table.state]];
}

export function Axis({rig, may}) {
  const [table, problem, again] = useValue("/rig/turntable", 10);
  const known = useBoard(rig);
  const [board, setBoard] = useState(USUAL_BOARD);
  const [first, setFirst] = useState("-50");
  const [step, setStep] = useState("20");
  const [count, setCount] = useState("6");
  const [job, setJob] = useState(null);
  const [asking, setAsking] = useState(false);
  const other = /^axis (.+)$/.exec(rig.holder ?? "")?.[1];
  useEffect(() => {
    if (other) setJob(other);
  }, [other]);
  const [start, busy, refused] = useAction(async () => {
    const body = {if_busy: "queue", first_deg: Number(first), step_deg: Number(step), count: Number(count), ...(known ? {} : {board})};
    setJob((await ask("POST", "/rig/turntable/shoot", {body, headers: once()})).id);
  });
  const [forget, , kept] = useAction(() => ask("DELETE", "/rig/turntable").then(() => (setAsking(false), again())));
  const able = may("calibrate");
  if (!table) return html`<${Refusal} problem=${problem?.status ? problem : null} />`;
  const [kind, word, words] = axisWords(table);
  const {axis, planes = [], history = []} = table.document;
  return html`<p><${Badge} kind=${kind}>${word}<//> ${words}</p>
    ${axis && html`<${Facts} of=${[["Its place, σ", length(table.point_sigma_mm)], ["Its direction, σ", `${table.direction_sigma_deg.toPrecision(2)}°`], ["Found last", moment(history.at(-1)?.at)]]} />`}
    ${job ? html`<${Running} key=${job} here=${`/rig/job/${job}`} may=${may} ended=${async () => (await again(), setJob(null))} />` : html`
      ${known === null && rig.calibrated && html`<${BoardFields} board=${board} changed=${setBoard} />`}
      <details><summary>Angles</summary><div class="row numbers"><${Field} label="First, °" value=${first} change=${setFirst} min="-360" max="360" /><${Field} label="From shot to shot, °" value=${step} change=${setStep} min="1" max="180" />
        <${Field} label="Shots" value=${count} change=${setCount} min="3" max="72" step="1" /></div></details>
      <div class="row"><${Action} busy=${busy} disabled=${!able || !rig.calibrated || known === undefined} onClick=${start}>Measure the axis<//>
        <span class="quiet">${!able ? "Your key may not measure the axis." : rig.calibrated === false ? html`The rig is not calibrated. <a href="#/calibrate">Calibrate it first</a>.` : known ? `Board: ${known.title}.` : ""}</span></div>`}
    <${Refusal} problem=${refused} />
    ${history.length > 0 && html`<details><summary>How the axis has moved</summary><div class="wide" tabindex="0" role="region" aria-label="Picture of the axis over time"><img class="trend" src=${`/rig/turntable.svg?of=${history.length}`} alt="How far each axis that was found is from the first one" /></div></details>`}
    <${Planes} planes=${planes} able=${able && table.state !== "unknown"} found=${again} />
    ${(axis || planes.length > 0) && (asking ? html`<${Confirm} question="Forget the measured axis, the planes and their history?" yes="Forget them" onYes=${forget} onNo=${() => setAsking(false)} />`
      : html`<${Action} kind="plain" disabled=${!able} onClick=${() => setAsking(true)}>Forget axis and planes<//>`)}
    <${Refusal} problem=${kept} />`;
}

/** What stands behind and beneath an object is cut away from its views by planes. */
function Planes({planes, able, found}) {
  const [list] = useValue("/scan?limit=20", 10);
  const scans = (list?.scans ?? []).filter(({state}) => state === "succeeded");
  const [chosen, setChosen] = useState("");
  const [find, busy, problem] = useAction(() => ask("POST", "/rig/turntable/planes", {body: {scan: chosen || scans[0].id}}).then(found));
  return html`<details><summary>Plate and backdrop: ${planes.length ? planes.map(({kind}) => PLANES[kind] ?? kind).join(", ") : "not known"}</summary>
    <p class="quiet">Scan the turntable with nothing on it. Its plate and what stands behind are then cut away from the views of models.</p>
    ${scans.length === 0 ? html`<p class="quiet">There is no scan yet. <a href="#/scan">Scan the empty turntable</a>.</p>` : html`<div class="row">
      <label>Scan of the empty turntable<select value=${chosen || scans[0].id} onChange=${(event) => setChosen(event.target.value)}>${scans.map((scan) => html`<option value=${scan.id}>${scan.label ?? moment(scan.created_at)}</option>`)}</select></label>
      <${Action} busy=${busy} disabled=${!able} onClick=${find}>Find the planes<//></div>`}
    <${Refusal} problem=${problem} /></details>`;
}
