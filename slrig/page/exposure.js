// Light and focus of the next scan: what the live picture says of them, a slider, and what a look at the object proposes.
import {html, useState} from "./vendor/preact-htm.js";
import {LEVELS} from "./live.js";
import {ask, useAction} from "./service.js";
import {Action, Refusal, duration, number, percent} from "./ui.js";

/** The live picture takes none longer. */
const LONGEST_S = 1;
const STEPS = 200;
/** Of the lit pixels: so much that mirrors is worth patterns that bear it. */
const MIRRORS = 0.01;

const times = (exposures_s) => exposures_s.map(duration).join(" and ");

/** The exposures that every camera can do and the projector's light is steady over, by a step of the slider. */
function scale(rig, now_s) {
  const least_s = Math.max(...rig.cameras.map((each) => each.exposure_range_s[0]), 1e-5);
  const most_s = Math.min(...rig.cameras.map((each) => each.exposure_range_s[1]), LONGEST_S);
  const steady_s = rig.projector?.refresh_s;
  return {
    at: (step) => {
      const asked_s = least_s * (most_s / least_s) ** (step / STEPS);
      const whole_s = steady_s ? Math.max(1, Math.round(asked_s / steady_s)) * steady_s : asked_s;
      return Number(Math.min(Math.max(whole_s, least_s), most_s).toPrecision(6));
    },
    now: Math.round((STEPS * Math.log(now_s / least_s)) / Math.log(most_s / least_s)),
  };
}

/**
 * figures : of the live picture, null where there is none. exposures_s : of the next scan, from short to long; null as
 * the rig is set. request : what else the next scan is asked for. robust() has it play patterns for what mirrors; null
 * where some were chosen.
 */
export function Exposure({rig, figures, exposures_s, setExposures, request, robust}) {
  const [best, setBest] = useState({camera: null, sharpness: 0});
  const [moving, setMoving] = useState(null);
  const [found, setFound] = useState(null);
  const [propose, busy, refused] = useAction(async () => {
    const proposal = await ask("POST", "/exposure", {body: request});
    setFound(proposal);
    setExposures(proposal.exposures.map((each) => each.exposure_s));
  });
  if (figures && (best.camera !== figures.camera || figures.sharpness > best.sharpness)) setBest(figures);
  const camera = rig.cameras.find((each) => each.name === figures?.camera) ?? rig.cameras[0];
  const now_s = moving ?? exposures_s?.[0] ?? camera?.exposure_s;
  const slider = now_s && scale(rig, now_s);
  const set = (step) => {
    setMoving(null);
    setFound(null);
    setExposures([slider.at(step)]);
  };
  return html`<div class="box exposure">
    ${figures && html`<div class="between">
      <span>${percent(figures.saturated)} saturated, ${percent(figures.dark)} too dark or in shadow</span>
      <span class="quiet">${camera?.gain ? html`Gain ${number(camera.gain)}, <a href="#/devices">change it</a>` : ""}</span></div>
      <${Histogram} levels=${figures.levels} />
      <label class="focus">Sharpness, of the best seen here <meter min="0" max="1" low="0.6" high="0.85" optimum="1" value=${figures.sharpness / (best.sharpness || 1)}></meter></label>`}
    ${slider && html`<label class="wide-label"><span class="between"><span>Exposure of the next scan</span><strong>${exposures_s?.length > 1 && moving === null ? times(exposures_s) : duration(now_s)}${exposures_s || moving !== null ? "" : ", as the rig is set"}</strong></span>
      <input type="range" min="0" max=${STEPS} value=${slider.now} onInput=${(event) => setMoving(slider.at(Number(event.target.value)))} onChange=${(event) => set(Number(event.target.value))} /></label>`}
    <div class="row">
      <${Action} busy=${busy} disabled=${!rig.open || Boolean(rig.holder)} onClick=${propose}>Look and propose<//>
      ${exposures_s && html`<${Action} kind="plain" onClick=${() => { setExposures(null); setFound(null); }}>As the rig is set<//>`}
    </div>
    ${found && html`<div role="status"><p>${times(found.exposures.map((each) => each.exposure_s))}: ${percent(found.completeness)} of what is lit can be read, in ${duration(found.seconds)}.</p>
      ${found.notes.length > 0 && html`<ul>${found.notes.map((note) => html`<li>${note}</li>`)}</ul>`}
      ${robust && found.saturated > MIRRORS && html`<p>Part of it mirrors the light. <${Action} onClick=${robust}>Use robust patterns<//></p>`}</div>`}
    <${Refusal} problem=${refused} />
  </div>`;
}

/** How many pixels have which brightness; a root, so that few are seen beside many. */
function Histogram({levels}) {
  const most = Math.max(...levels);
  const bars = levels.map((share, at) => `M${at} 24V${(24 - 24 * Math.sqrt(share / most)).toFixed(2)}h1V24`).join("");
  let seen = 0;
  const median = levels.findIndex((share) => (seen += share) >= 0.5);
  return html`<svg class="histogram" viewBox=${`0 0 ${LEVELS} 24`} preserveAspectRatio="none" role="img" aria-label=${`Brightness of the picture, dark to bright: half of it is below ${percent((median + 1) / LEVELS)}`}><path d=${bars} /></svg>`;
}
