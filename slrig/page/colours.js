// Numbers for each vertex that the files of a scan do not hold: the cause at a camera's pixel, how many cameras measured there, how far another scan is.
import {html, useEffect, useState} from "./vendor/preact-htm.js";
import {readCauses} from "./causes.js";
import {NOT_KNOWN, plainMesh} from "./deviation.js";
import {UNSEEN, valuesAt} from "./projection.js";
import {Choice, length, percent} from "./ui.js";

const NOTHING = {values: null, kinds: [], range: null, words: null};
const HIDDEN = {colour: "#4a545b", words: "this camera does not see it"};
const VIEWS = ["#4a545b", "#56b4e9", "#f0e442", "#e69f00", "#d55e00"];

/**
 * What a mode needs besides the mesh: `values` for each vertex, `kinds` of them [{colour, words, share}], their `range`, `words` for the legend, a `chooser` of what they
 * are of, and `busy` in words. `calibration`: the scan's own, or null. `offers(mode)`: can it be shown of this scan.
 */
export function useTold({scan, report, calibration, mesh, other, mode}) {
  const cameras = Object.keys(calibration?.cameras ?? {}).filter((name) => report?.causes && scan.links.files[`causes-${name}.png`]);
  const [chosen, setCamera] = useState(null);
  const camera = chosen ?? cameras[0];
  const [found, setFound] = useState({mode: null, ...NOTHING});
  const [busy, setBusy] = useState(null);
  const wanted = {cause: mesh && camera, views: mesh && camera, deviation: mesh && other}[mode];
  useEffect(() => {
    if (!wanted) return undefined;
    let left = false;
    let worker = null;
    setBusy(mode === "deviation" ? "Comparing the two scans …" : "Reading the cameras' causes …");
    const make = async () => {
      if (mode === "deviation") {
        worker = new Worker(new URL("./deviation.js", import.meta.url), {type: "module"});
        return deviation(worker, mesh, other);
      }
      const read = async (name) => valuesAt(mesh, calibration.cameras[name], await readCauses(scan.links.files[`causes-${name}.png`]));
      return mode === "cause" ? byCause(await read(camera), report.causes) : byViews(await Promise.all(cameras.map(read)), report.causes);
    };
    make().then((made) => !left && setFound({...NOTHING, mode, ...made}), (error) => !left && setFound({...NOTHING, mode, words: `It could not be computed: ${error.message ?? "the worker failed"}.`}))
      .finally(() => !left && setBusy(null));
    return () => {
      left = true;
      worker?.terminate();
      setBusy(null);
    };
  }, [mode, camera, mesh, other, calibration]);
  const offers = (name) => ({
    stripe: !scan.merged, cause: cameras.length > 0, views: cameras.length > 1, deviation: other !== null,
  })[name] ?? true;
  const chooser = mode === "cause" && cameras.length > 1 && html`<${Choice} label="Camera" value=${camera} options=${cameras.map((name) => [name, name])} chosen=${setCamera} />`;
  return {...found.mode === mode ? found : NOTHING, offers, chooser, busy};
}

/** Kinds with the share of the vertices that are of each. */
function shared(values, kinds) {
  const counts = new Uint32Array(kinds.length);
  for (const value of values) counts[value] += 1;
  return {values, kinds: kinds.map((kind, at) => ({...kind, share: counts[at] / values.length}))};
}

function byCause(codes, causes) {
  const kinds = [...causes.map(({colour, words}) => ({colour, words})), HIDDEN];
  return shared(Float32Array.from(codes, (code) => code === UNSEEN ? causes.length : code), kinds);
}

function byViews(maps, causes) {
  const measured = causes.findIndex(({name}) => name === "none");
  const values = Float32Array.from(maps[0], (_, vertex) => maps.reduce((sum, codes) => sum + (codes[vertex] === measured), 0));
  const kinds = Array.from({length: maps.length + 1}, (_, views) => ({colour: VIEWS[Math.min(views, VIEWS.length - 1)], words: views === 1 ? "1 camera measured here" : `${views || "no"} cameras measured here`}));
  return shared(values, kinds);
}

async function deviation(worker, mesh, other) {
  const of = plainMesh(mesh);
  const from = plainMesh(other);
  const {values, reachMm} = await new Promise((resolve, reject) => {
    worker.onmessage = ({data}) => resolve(data);
    worker.onerror = reject;
    worker.postMessage({of, from}, [of.positions.buffer, of.corners.buffer, from.positions.buffer, from.corners.buffer]);
  });
  worker.terminate();
  const sizes = Float32Array.from(values.filter((value) => value !== NOT_KNOWN), Math.abs).sort();
  if (sizes.length === 0) return {values, words: `Nothing of the other scan is within ${length(reachMm)}.`};
  const [half, most] = [0.5, 0.95].map((share) => sizes[Math.floor(share * (sizes.length - 1))]);
  const sigmaMm = Math.hypot(typicalSigma(mesh), typicalSigma(other));
  const words = `Half lie within ${length(half)}, 95 % within ${length(most)}; ${percent(sizes.length / values.length)} could be compared. σ of the difference: ${length(sigmaMm)}; less than twice that says nothing.`;
  return {values, range: [-most, most], words};
}

function typicalSigma({attributes: {_SIGMA: {array, width}}, vertices, sigmaStepMm}) {
  const some = Array.from({length: Math.min(vertices, 10_000)}, (_, at) => array[Math.floor((at * vertices) / Math.min(vertices, 10_000)) * width]).filter((stored) => stored !== NOT_KNOWN).sort((a, b) => a - b);
  return some.length ? some[some.length >> 1] * sigmaStepMm : NaN;
}
