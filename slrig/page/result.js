// placeholder until the next slice
import {html} from "./vendor/preact-htm.js";
export const ResultScreen = () => html`<p class="quiet">…</p>`;
