// Fleet: the rigs that share a catalogue with this one; how each is, and what it did last.
import {useValue} from "./service.js";
import {Badge, JobBadge, Refusal, begun, moment} from "./ui.js";
import {html} from "./vendor/preact-htm.js";

const STATES = {
  ready: ["good", "Ready"], busy: ["busy", "Busy"], opening: ["busy", "Opening"], fault: ["bad", "Not ready"],
  stopped: ["", "Stopped"], unseen: ["warn", "Not seen"],
};
const HEALTH = {good: ["good", "Good"], watch: ["warn", "Watch"], stale: ["bad", "Stale"]};

export function FleetScreen({rig}) {
  const [fleet, problem] = useValue("/fleet", 10);
  const rigs = fleet?.rigs ?? [];
  const away = rigs.filter(({state}) => state === "unseen").length;
  const ill = rigs.filter(({state}) => state === "fault").length;
  return html`<section aria-label="Fleet"><h2>Fleet</h2>
    <${Refusal} problem=${problem?.status ? problem : null}>${fleet && html`<p>The table shows what was known before.</p>`}<//>
    ${fleet && html`<p role="status">${rigs.length} ${rigs.length === 1 ? "rig" : "rigs"}${ill > 0 && `, ${ill} not ready`}${away > 0 && `, ${away} not seen for a minute or longer`}</p>
    <div class="wide" tabindex="0" role="region" aria-label="Rigs"><table class="broad">
      <thead><tr><th scope="col">Rig</th><th scope="col">State</th><th scope="col">Health</th><th scope="col">Jobs waiting</th><th scope="col">Last scan</th><th scope="col">Scans in 24 hours</th></tr></thead>
      <tbody>${rigs.map((each) => html`<${Row} key=${each.name} each=${each} here=${each.name === rig?.name} stale=${Boolean(problem)} />`)}</tbody>
    </table></div>`}
  </section>`;
}

/** stale : the catalogue was lost since, and what a rig is now is not known. */
function Row({each, here, stale}) {
  const [kind, word] = stale && each.state !== "stopped" ? STATES.unseen : STATES[each.state];
  const known = !stale && each.health !== null;
  const last = each.last_scan;
  return html`<tr>
    <th scope="row">${each.name}<div class="quiet">${here && "This one, on "}${each.host}</div></th>
    <td><${Badge} kind=${kind}>${word}<//><div class="quiet">Seen ${moment(new Date(Date.now() - 1000 * each.seen_s).toISOString())}</div>${known && each.words && html`<div class="quiet clip">${begun(each.words)}</div>`}</td>
    <td>${known ? html`<${Badge} kind=${HEALTH[each.health]?.[0] ?? ""}>${HEALTH[each.health]?.[1] ?? "Not known"}<//>` : "Not known"}
      ${known && each.health !== "good" && html`<div class="quiet clip">${begun(each.health_message)}</div>`}</td>
    <td>${known ? each.waiting + each.computing : "Not known"}${known && each.uncopied > 0 && html`<div class="quiet">${each.uncopied} to copy</div>`}</td>
    <td>${last ? html`<${JobBadge} state=${last.state} /> ${moment(last.finished_at)}<div class="quiet clip">${last.error ?? last.label}</div>` : "None yet"}</td>
    <td>${each.scans_of_day}${each.failed_of_day > 0 && html` <${Badge} kind="bad">${each.failed_of_day} failed<//>`}</td>
  </tr>`;
}
