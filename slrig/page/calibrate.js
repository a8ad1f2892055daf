// placeholder until the next slice
import {html} from "./vendor/preact-htm.js";
export const CalibrateScreen = () => html`<p class="quiet">…</p>`;
