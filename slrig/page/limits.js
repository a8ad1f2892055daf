// What the next scan of this window is limited to, and what a scan was limited to, in words.
import {html, useState} from "./vendor/preact-htm.js";
import {Action, Field, length, percent} from "./ui.js";

const KEPT = "limits";
/** Where only the nearest depth is given. */
const FURTHEST_MM = 1e5;

/** What is typed, kept until the window is closed; the region that it stands for, null for everything; how to change it. */
export function useLimits() {
  const [typed, setTyped] = useState(() => JSON.parse(sessionStorage.getItem(KEPT) ?? "{}"));
  const {near, far, contrast, sigma, box} = typed;
  const region = {
    ...(near || far) && {depth_mm: [Number(near || 0), Number(far || FURTHEST_MM)]}, ...contrast && {min_contrast: contrast / 100},
    ...sigma && {max_sigma_mm: Number(sigma)}, ...box && {box_mm: box},
  };
  const change = (part) => {
    sessionStorage.setItem(KEPT, JSON.stringify({...typed, ...part}));
    setTyped({...typed, ...part});
  };
  return [typed, limits(region) ? region : null, change];
}

/** Have the next scan measure only what is in a box, mm, beside what else is typed; null, where nothing is seen, changes nothing. */
export function limitToBox(box) {
  if (!box) return;
  sessionStorage.setItem(KEPT, JSON.stringify({...JSON.parse(sessionStorage.getItem(KEPT) ?? "{}"), box}));
  location.hash = "#/scan";
}

/** others: what the rig limits a scan to where nothing is typed here. */
export function Limits({typed, region, change, others, preset}) {
  const [open] = useState(region !== null);
  const of = (name) => ({value: typed[name] ?? "", change: (value) => change({[name]: value})});
  return html`<details class="panel" open=${open}><summary><h3>Limit the scan</h3></summary>
    <div class="row numbers"><${Field} label="Nearest depth, mm" ...${of("near")} /><${Field} label="Farthest depth, mm" ...${of("far")} /></div>
    <div class="row numbers"><${Field} label="Least contrast, %" ...${of("contrast")} max="100" /><${Field} label="Greatest σ, mm" ...${of("sigma")} /></div>
    <p class="quiet">${region ? `The next scan measures: ${limits(region)}. Other limits of the rig or a preset do not count then.`
      : limits(others) ? `As the rig is set, the next scan measures: ${limits(others)}.`
      : preset ? `The next scan measures what ${preset} says.` : "The next scan measures all that it sees."}
      ${typed.box && html` <${Action} onClick=${() => change({box: null})}>Without the box<//>`}</p></details>`;
}

/** What a scan was asked for, in words; null for everything. */
export function limits(region) {
  if (!region) return null;
  const {box_mm: box, depth_mm: depth, polygons_px: polygons, masks, min_contrast: contrast, max_sigma_mm: sigma} = region;
  return [
    box && `a box, ${["x", "y", "z"].map((axis, at) => `${axis} ${box[0][at]} to ${box[1][at]}`).join(", ")} mm`,
    depth && `depths of ${depth[0]} to ${depth[1]} mm`,
    ...Object.keys({...polygons, ...masks}).map((camera) => `a part of camera ${camera}'s image`),
    contrast && `contrasts above ${percent(contrast)}`, sigma && `σ up to ${length(sigma)}`,
  ].filter((each) => each).join("; ");
}
