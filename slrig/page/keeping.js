// What becomes of a scan or a model: stopped while it runs, pinned so that it stays, or deleted.
import {ask, useAction} from "./service.js";
import {Action, Confirm, Refusal} from "./ui.js";
import {html, useState} from "./vendor/preact-htm.js";

const QUESTIONS = {scan: "Delete this scan with all its files? Nothing brings it back.", model: "Delete this model with all its files? Its scans stay."};

/** job: a scan or a model, `kind` says which; over: whether it has ended. */
export function Keeping({job, kind, over, again}) {
  const [sure, setSure] = useState(false);
  const [cancel, cancelling, uncancelled] = useAction(() => ask("POST", job.links.cancel).then(again));
  const [pin, pinning, unpinned] = useAction(() => ask(job.pinned ? "DELETE" : "PUT", `${job.links.self}/pin`).then(again));
  const [remove, removing, unremoved] = useAction(() => ask("DELETE", job.links.self).then(() => {
    location.hash = kind === "scan" ? "#/scan" : "#/models";
  }));
  return html`
    ${sure ? html`<${Confirm} question=${QUESTIONS[kind]} yes="Delete it" onYes=${remove} onNo=${() => setSure(false)} />`
    : over ? html`<div class="row"><${Action} busy=${pinning} onClick=${pin}>${job.pinned ? "Unpin" : "Pin"}<//>
        <${Action} busy=${removing} onClick=${() => setSure(true)}>Delete<//>
        <span class="quiet">${job.pinned ? "It stays when old ones are deleted." : "What is pinned stays when old ones are deleted."}</span></div>`
    : html`<${Action} busy=${cancelling} onClick=${cancel}>Stop it<//>`}
    <${Refusal} problem=${uncancelled ?? unpinned ?? unremoved} />`;
}
