// placeholder until the next slice
import {html} from "./vendor/preact-htm.js";
export const DevicesScreen = () => html`<p class="quiet">…</p>`;
