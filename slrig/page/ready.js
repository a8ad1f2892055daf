// Whether a scan can begin now; where it cannot, why, and what helps.
import {html} from "./vendor/preact-htm.js";
import {moment} from "./ui.js";

const ID = /^[0-9a-f]{8}-[0-9a-f-]{27}$/;
const LOADED = "ok";

/** Who holds the rig, as people say it: a holder is the id of a scan, or other work by name. */
export function holderWords({holder, since}) {
  const work = ID.test(holder) ? "scan" : holder.replace(/ [0-9a-f]{8}-[0-9a-f-]{27}$/, "");
  return `The rig is in use by ${/^[aeiou]/.test(work) ? "an" : "a"} ${work}${since ? `, since ${new Date(since).toLocaleTimeString("en-GB", {timeStyle: "short"})}` : ""}.`;
}

/** Why no scan can begin now: {words, help: [address, words]}; null where one can. `may` : see the page's session. */
export function whyNot(rig, may) {
  if (!may("scan")) return {words: "Your key is for looking only. Scanning takes one with the scope “scan”."};
  if (!rig) return {words: "The service has not told of the rig yet."};
  // The next scan tries to open it again.
  if (rig.error) return null;
  if (!rig.open) return {words: "The rig is being opened. Scanning is possible in a moment."};
  if (rig.calibration?.error) return {words: `The calibration in use does not fit this rig: ${rig.calibration.error}`, help: ["#/calibrate", "Calibrate"]};
  if (rig.calibrated === false) return {words: "This rig is not calibrated. Calibrate it before you scan.", help: ["#/calibrate", "Calibrate"]};
  if (rig.holder) return {words: holderWords(rig)};
  if (rig.reconstruction !== LOADED && !rig.preparing) return {words: `Nothing can be computed now: ${rig.reconstruction}.`, help: ["#/devices", "Devices"]};
  return null;
}

/** That the rig is being opened, and how far that is. */
export const Opening = ({rig}) => html`<div class="opening" role="status"><p>The rig is being opened.</p>
  <progress aria-label="Opening the rig"></progress>
  <p class="quiet">${rig.opening || "Its devices are starting."}</p></div>`;
