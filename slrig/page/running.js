// A job that has the rig: how far it is, how it is stopped, and why it ended early.
import {html, useEffect, useState} from "./vendor/preact-htm.js";
import {ask, follow, useAction} from "./service.js";
import {Action, Progress, Refusal} from "./ui.js";

/** `ended` is called when it succeeded, or its failure was read. */
export function Running({here, may, ended}) {
  const [at, setAt] = useState({stage: "waits for the rig", fraction: 0});
  const [failed, setFailed] = useState(null);
  useEffect(() => {
    const look = async () => {
      const body = await ask("GET", here);
      if (body.error) setFailed(body);
      else if (body.state === "succeeded") ended();
    };
    return follow(`${here}/events`, (kind, data) => {
      if (kind === "progress") setAt(data);
      if (kind === "state") look();
    }, look);
  }, [here]);
  const [cancel, busy, refused] = useAction(() => ask("POST", `${here}/cancel`));
  if (failed?.state === "cancelled") return html`<div class="row"><span role="status">You stopped it.</span><${Action} onClick=${ended}>Close<//></div>`;
  if (failed) return html`<${Refusal} problem=${{document: {title: "It ended early"}, message: failed.error.detail}}>
    <${Action} onClick=${ended}>Close<//><//>`;
  return html`<${Progress} label=${at.stage} fraction=${at.fraction} detail=${at.detail} />
    <${Action} busy=${busy} disabled=${!may("calibrate")} onClick=${cancel}>Cancel<//>
    <${Refusal} problem=${refused} />`;
}
