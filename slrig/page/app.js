// The page as a whole: who is let in, which screen is shown, and what the rig is doing.
import {html, render, useEffect, useState} from "./vendor/preact-htm.js";
import {CalibrateScreen} from "./calibrate.js";
import {DevicesScreen} from "./devices.js";
import {FleetScreen} from "./fleet.js";
import {HealthScreen} from "./health.js";
import {ModelsScreen} from "./models.js";
import {ResultScreen} from "./result.js";
import {ScanScreen} from "./scan.js";
import {ScansScreen} from "./scans.js";
import {ask, entered, useAction, useValue, watchProblems} from "./service.js";
import {Action, Badge, Refusal, usePlace} from "./ui.js";

const SCREENS = [
  ["scan", "Scan"],
  ["models", "Models"],
  ["calibrate", "Calibrate"],
  ["health", "Health", " and schedule"],
  ["devices", "Devices"],
  ["fleet", "Fleet"],
];

function Page() {
  const [session, setSession] = useState(null);
  const [lost, setLost] = useState(false);
  useEffect(() => watchProblems((problem) => {
    setLost(problem?.status === 0);
    // What was typed stays behind the form until somebody is let in again.
    if (problem?.status === 401) setSession((before) => (before === null || before === "none" ? "none" : {...before, over: true}));
  }), []);
  const enter = (opened) => {
    setSession(opened);
    entered();
  };
  const look = () => ask("GET", "/session").then(setSession, () => {});
  useEffect(() => {
    look();
  }, []);
  useEffect(() => {
    if (!lost) return undefined;
    const timer = setInterval(look, 2000);
    return () => clearInterval(timer);
  }, [lost]);
  return html`
    ${lost && html`<div class="lost" role="alert">The service does not answer. The page tries again by itself; nothing that the service has begun is lost.</div>`}
    ${(session === "none" || session?.over) && html`<${LogIn} over=${session.over} done=${enter} />`}
    ${session?.scopes && html`<div class="rooms" hidden=${session.over}><${Rooms} session=${session} left=${() => setSession("none")} /></div>`}
    ${session === null && html`<p class="wait">Asking the service …</p>`}`;
}

function LogIn({over, done}) {
  const [key, setKey] = useState("");
  const [enter, busy, problem] = useAction(async () => done(await ask("POST", "/session", {headers: {Authorization: `Bearer ${key.trim()}`}})));
  const submit = (event) => {
    event.preventDefault();
    enter();
  };
  return html`<main class="login"><h1>slrig</h1>
    ${over && html`<p class="warning" role="alert">Your session is over: its time is up, its key has ended, or the service was started anew. Enter a key to go on where you were.</p>`}
    <form onSubmit=${submit}>
      <label for="key">Key</label>
      <input id="key" type="password" autocomplete="current-password" value=${key} onInput=${(event) => setKey(event.target.value)} required />
      <button class="action primary" type="submit" aria-busy=${busy} disabled=${busy}>Enter</button>
    </form>
    <${Refusal} problem=${problem} />
    <p class="quiet">Or open the link that <code>slrig serve</code> prints at its start. <code>slrig key add NAME</code> makes a key.</p>
  </main>`;
}

function Rooms({session, left}) {
  const [room = "scan", ...rest] = usePlace();
  const [rig, , again] = useValue("/rig", 1);
  useEffect(() => {
    document.title = `${(SCREENS.find(([name]) => name === room) ?? SCREENS[0])[1]} · ${rig?.name ?? "slrig"}`;
  }, [room, rig?.name]);
  const leave = async () => {
    await ask("DELETE", "/session").catch(() => {});
    left();
  };
  const may = (scope) => session.scopes.includes(scope);
  const given = {rig, again, may, place: rest};
  const screens = {
    scan: rest[0] === "all" ? html`<${ScansScreen} ...${given} />` : rest.length ? html`<${ResultScreen} key=${rest[0]} id=${rest[0]} ...${given} />` : html`<${ScanScreen} ...${given} />`,
    models: html`<${ModelsScreen} ...${given} />`,
    calibrate: html`<${CalibrateScreen} ...${given} />`,
    health: html`<${HealthScreen} ...${given} />`,
    devices: html`<${DevicesScreen} ...${given} />`,
    fleet: html`<${FleetScreen} ...${given} />`,
  };
  const offered = SCREENS.filter(([name]) => name !== "fleet" || rig?.fleet);
  return html`
    <a class="skip" href="#content">Skip to the content</a>
    <header>
      <h1>${rig?.name ?? "slrig"}</h1><${RigState} rig=${rig} />
      <nav aria-label="Screens">${offered.map(([name, words, more]) => html`<a href=${`#/${name}`} aria-current=${name === room ? "page" : null}>${words}${more && html`<span>${more}</span>`}</a>`)}</nav>
      ${session.name !== "anyone" && html`<span class="who quiet">${session.name}</span><${Action} kind="plain" onClick=${leave}>Log out<//>`}
    </header>
    <main id="content" tabindex="-1">${screens[room] ?? html`<p>There is no such screen. <a href="#/scan">Scan</a></p>`}</main>`;
}

function RigState({rig}) {
  if (!rig) return html`<${Badge} kind="busy">Asking<//>`;
  if (rig.error) return html`<${Badge} kind="bad">Not ready<//>`;
  if (!rig.open) return html`<${Badge} kind="busy">Opening<//>`;
  if (rig.holder) return html`<${Badge} kind="busy">Busy<//>`;
  if (rig.calibrated === false) return html`<${Badge} kind="warn">Not calibrated<//>`;
  return html`<${Badge} kind="good">Ready<//>`;
}

render(html`<${Page} />`, document.getElementById("app"));
