// Devices: the rig as it is and as it is set, its tests, what else is plugged in, and who is logged in.
import {html} from "./vendor/preact-htm.js";
import {Tests} from "./examine.js";
import {FileText, Reopen, Settings} from "./rigfile.js";
import {useAction, useValue} from "./service.js";
import {Action, Badge, Facts, Refusal, duration, moment, number} from "./ui.js";

const between = ([least, most], words) => (least === most ? `${words(least)} only` : `${words(least)} to ${words(most)}`);

export function DevicesScreen({rig, again, may}) {
  const [file, , readFile] = useValue(may("administer") ? "/rig/file" : null, 10);
  const given = {file, rig, may, changed: () => Promise.all([readFile(), again()])};
  return html`<section aria-label="This rig"><${ThisRig} ...${given} /></section>
    <section aria-label="Tests of the rig"><${Tests} ...${given} /></section>
    <section aria-label="Plugged in"><${PluggedIn} rig=${rig} /></section>
    <section aria-label="You"><${You} may=${may} /></section>`;
}

function ThisRig(given) {
  const {file, rig} = given;
  if (!rig) return html`<p class="wait">Asking the service …</p>`;
  const {cameras, projector} = rig;
  return html`<h2>This rig</h2>
    ${rig.error && html`<${Refusal} problem=${{document: {title: "The rig is not open"}, message: rig.error}}><p>Put that right, then open the rig again; the next scan tries, too.</p><//>`}
    ${!rig.open && !rig.error && html`<p role="status">The rig is being opened …</p>`}
    ${Object.entries(rig.lost_cameras ?? {}).map(([name, why]) => html`<p class="warning" key=${name}>Camera ${name} cannot be opened, and scans go on without it: ${why}. The next scan looks for it again.</p>`)}
    <ul class="cards">${cameras.map((camera) => html`<li class="box" key=${camera.name}><${Camera} camera=${camera} /></li>`)}
      ${projector && html`<li class="box"><h3>Projector${projector.name === "projector" ? "" : ` ${projector.name}`}</h3><${Facts} of=${[
        ["Model", projector.model],
        ["Serial number", projector.serial || null],
        ["Pixels", projector.size_px.join(" × ")],
        ["Sequences", projector.plays ? "plays them by itself" : "shows one pattern at a time"],
        ["From command to light", duration(projector.latency_s)],
      ]} /></li>`}</ul>
    <${Reopen} ...${given} />
    ${file && html`<${Settings} ...${given} /><${FileText} ...${given} />`}`;
}

function Camera({camera}) {
  const set = camera.exposure_s !== null;
  return html`<h3>Camera ${camera.name}</h3>
    <${Facts} of=${[
      ["Exposure in use", set ? duration(camera.exposure_s) : "not set yet"],
      ["Gain in use", set ? number(camera.gain) : "not set yet"],
      ["Exposures it takes", between(camera.exposure_range_s, duration)],
      ["Gains it takes", between(camera.gain_range, (value) => number(value))],
      ["Model", camera.model],
      ["Serial number", camera.serial || null],
      ["Pixels", `${camera.size_px.join(" × ")}, ${camera.bit_depth} bits`],
      ["Triggered by", camera.triggers.join(", ")],
    ]} />
    ${!set && html`<p class="quiet">It is set by the first scan, or live picture.</p>`}
    ${camera.notes.length > 0 && html`<ul>${camera.notes.map((note) => html`<li class="warning">${note}</li>`)}</ul>`}`;
}

function PluggedIn({rig}) {
  const [found, problem, again] = useValue("/device");
  const [look, busy] = useAction(again);
  // A rig file may name a device in several ways; what has the serial number of the rig's device is that one.
  const serials = [...(rig?.cameras ?? []), rig?.projector].map((each) => each?.serial).filter((serial) => serial?.length >= 4);
  const inRig = ({device, label}) => serials.some((serial) => device.includes(serial) || label.includes(serial));
  const broken = found?.drivers.filter((driver) => driver.fault) ?? [];
  return html`<h2>Plugged in</h2>
    <${Action} busy=${busy || (!found && !problem)} onClick=${look}>Look again<//>
    ${!found && !problem && html`<p role="status">Every driver is asked what it sees …</p>`}
    <${Refusal} problem=${problem} />
    ${found?.devices.length === 0 && html`<p>No device is plugged in that an installed driver can find. Check cable and power. A rendered rig needs none.</p>`}
    ${found?.devices.length > 0 && html`<div class="wide" tabindex="0" role="region" aria-label="Devices that are plugged in"><table class="broad">
      <thead><tr><th scope="col">Driver</th><th scope="col">Device, as a rig file names it</th><th scope="col">What it is</th></tr></thead>
      <tbody>${found.devices.map((each) => html`<tr><td>${each.driver}</td><td><code>${each.device}</code></td><td>${each.label} ${inRig(each) && html`<${Badge} kind="good">in this rig<//>`}</td></tr>`)}</tbody>
    </table></div>`}
    ${found?.missing.length > 0 && html`<h3>More devices can be used after</h3>
      <ul>${found.missing.map(({driver, install}) => html`<li>${driver}: <code>${install}</code></li>`)}</ul>`}
    ${(broken.length > 0 || found?.faults.length > 0) && html`<h3>Drivers that do not work</h3>
      <ul>${[...new Set([...broken.map((driver) => driver.fault), ...found.faults])].map((fault) => html`<li class="warning">${fault}</li>`)}</ul>`}
    ${found && html`<details><summary>Installed drivers</summary>
      <p>${found.drivers.filter(({kind}) => kind !== "finder").map(({kind, name}) => `${name} (${kind})`).join(", ")}</p>
      ${found.elsewhere.map(({message}) => html`<p class="quiet">${message}</p>`)}</details>`}`;
}

function You({may}) {
  const [session] = useValue("/session");
  const [audit, problem] = useValue(may("administer") ? "/audit?limit=10" : null, 10);
  if (!session) return null;
  return html`<h2>You</h2>
    <p>${session.name === "anyone" ? "This service needs no key." : html`Logged in as <strong>${session.name}</strong>, ${session.expires_at ? `until ${new Date(session.expires_at).toLocaleString("en-GB", {dateStyle: "medium", timeStyle: "short"})}` : "without end"}.`}
      ${" "}You may ${session.scopes.join(", ")}.</p>
    <${Refusal} problem=${problem?.status ? problem : null} />
    ${audit && html`<div class="wide" tabindex="0" role="region" aria-label="Who did what last"><table class="broad"><caption>Who did what last</caption>
      <thead><tr>${["When", "Who", "From", "What", "Answer"].map((head) => html`<th scope="col">${head}</th>`)}</tr></thead>
      <tbody>${audit.entries.map((each) => html`<tr><td>${moment(each.at)}</td><td>${each.who}</td><td>${each.address}</td><td>${each.method} ${each.path}</td><td>${each.status}</td></tr>`)}</tbody>
    </table></div>`}`;
}
