// Alerts: the receivers of notices, and a test notice.
import {html, useState} from "./vendor/preact-htm.js";
import {ask, useAction, useValue} from "./service.js";
import {Action, Badge, Refusal, duration} from "./ui.js";

const EVENTS = {
  "health.changed": "The rig's health changed", "run.failed": "A scheduled run failed", "run.missed": "A scheduled run was missed",
  "run.skipped": "A scheduled run was skipped: the rig was busy", "run.interrupted": "A scheduled run was interrupted", "job.ended": "Any job ended, scans too",
};
const USUAL = Object.keys(EVENTS).filter((kind) => kind !== "job.ended");
const NAMES = {webhook: "Webhook", mqtt: "MQTT broker"};

export function Alerts({may}) {
  const [list, problem, again] = useValue("/notices", 10);
  const receivers = list?.receivers ?? [];
  const able = may("administer");
  const [trials, setTrials] = useState({});
  const test = async (name) => {
    const trial = await ask("POST", `/notices/${name}/test`);
    setTrials((before) => ({...before, [name]: {...trial, at: new Date()}}));
  };
  return html`<h2>Alerts</h2>
    <${Refusal} problem=${problem?.status ? problem : null} />
    ${receivers.map((each) => html`<${Receiver} key=${each.name} of=${each} able=${able} test=${test} trial=${trials[each.name]} changed=${again} />`)}
    ${list && receivers.length === 0 && html`<p class="quiet">Nobody is told when a scheduled run fails or the rig's health changes.</p>`}
    ${list && !receivers.some(({name}) => name === "webhook") && (able ? html`<${Setting} test=${test} changed=${again} />` : html`<p class="quiet">Setting an alert takes a key that may administer.</p>`)}`;
}

function Receiver({of, able, test, trial, changed}) {
  const [send, sending, refused] = useAction(() => test(of.name));
  const [remove, removing, kept] = useAction(async () => {
    await ask("DELETE", "/notices/webhook");
    await changed();
  });
  const name = NAMES[of.name] ?? of.name;
  return html`<section class="box" aria-label=${name}>
    <p><strong>${name}</strong> at ${of.host}${of.fixed && html` <span class="quiet">(in the service's settings)</span>`}
      ${of.waiting > 0 && html` <${Badge} kind="warn">${of.waiting} waiting, the oldest for ${duration(of.oldest_s)}<//>`}</p>
    <p class="quiet">Told when: ${of.kinds.length === Object.keys(EVENTS).length ? "anything below happens" : of.kinds.map((kind) => EVENTS[kind] ?? kind).join("; ")}.</p>
    ${able && html`<div class="row"><${Action} busy=${sending} onClick=${send}>Send a test notice<//>
      ${!of.fixed && html`<${Action} busy=${removing} onClick=${remove}>Remove<//>`}</div>`}
    <${Refusal} problem=${refused ?? kept} />
    <div role="status">${trial && html`<${Trial} of=${trial} />`}</div>
  </section>`;
}

function Trial({of}) {
  return html`<p><${Badge} kind=${of.taken ? "good" : "bad"}>${of.taken ? "Delivered" : "Not delivered"}<//>
      ${" "}at ${of.at.toLocaleTimeString("en-GB")}, after ${duration(of.seconds)}: ${of.answer}.</p>
    <details><summary>What was sent</summary><pre tabindex="0" aria-label="The test notice">${JSON.stringify(of.sent, null, 2)}</pre></details>`;
}

function Setting({test, changed}) {
  const [url, setUrl] = useState("");
  const [kinds, setKinds] = useState(USUAL);
  const [save, busy, refused] = useAction(async () => {
    await ask("PUT", "/notices/webhook", {body: {url: url.trim(), kinds}});
    await changed();
    await test("webhook");
  });
  const submit = (event) => {
    event.preventDefault();
    save();
  };
  const change = (kind, on) => setKinds(Object.keys(EVENTS).filter((each) => (each === kind ? on : kinds.includes(each))));
  return html`<form class="box" aria-label="Set an alert" onSubmit=${submit}>
    <div class="row"><label>Address of a webhook
      <input type="url" required maxlength="2000" placeholder="https://…" value=${url} onInput=${(event) => setUrl(event.target.value)} /></label>
      <${Action} kind="primary" type="submit" busy=${busy} disabled=${kinds.length === 0}>Save and send a test notice<//></div>
    <p class="quiet">It gets JSON by POST, such as a topic of ntfy, Home Assistant, Node-RED, or a server of yours. An MQTT broker is set in the service's settings (<code>mqtt_url</code>).</p>
    <details><summary>Which events: ${kinds.length} of ${Object.keys(EVENTS).length}</summary>
      <fieldset><legend>Tell when</legend>${Object.entries(EVENTS).map(([kind, words]) => html`<div><label class="tick"><input type="checkbox" checked=${kinds.includes(kind)} onChange=${(event) => change(kind, event.target.checked)} /> ${words}</label></div>`)}</fieldset></details>
    <${Refusal} problem=${refused} />
  </form>`;
}
