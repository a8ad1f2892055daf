// The calibration board that stands before the camera: known by the calibration in use, or told by a person.
import {html} from "./vendor/preact-htm.js";
import {useValue} from "./service.js";

/** The board that `slrig calibrate board` prints unless it is told otherwise. */
export const USUAL_BOARD = {kind: "charuco", corners: [11, 8], square_mm: 12};

/** The board of the calibration in use: null where no calibration tells of one, undefined before that is known. */
export function useBoard(rig) {
  const id = rig?.calibration?.source === "session" ? rig.calibration.id : null;
  const [calibration] = useValue(id && `/calibration/${id}`);
  if (typeof rig?.calibrated !== "boolean" || (id && !calibration)) return undefined;
  return calibration?.board ?? null;
}

/** What is printed on the board, for a person to say. */
export function BoardFields({board, changed}) {
  const number = (words, value, told, step) => html`<label>${words}
    <input type="number" min=${step} step=${step} value=${value} required onInput=${(event) => told(Number(event.target.value))} /></label>`;
  const [columns, rows] = board.corners;
  return html`<fieldset><legend>The board in view</legend>
    <p class="quiet">No calibration in use tells which board it is. The line printed on its sheet does.</p>
    <div class="row">
      <label>Kind
        <select value=${board.kind} onChange=${(event) => changed({...board, kind: event.target.value})}>
          <option value="charuco">ChArUco</option><option value="chessboard">Chessboard</option><option value="circles">Circles</option>
        </select></label>
      ${number("Corners across", columns, (value) => changed({...board, corners: [value, rows]}), 1)}
      ${number("Corners down", rows, (value) => changed({...board, corners: [columns, value]}), 1)}
      ${number("Square, mm", board.square_mm, (value) => changed({...board, square_mm: value}), 0.001)}
    </div>
  </fieldset>`;
}

/** Where the board is to be: as it stands, or a position of the rig's positioner. `value` null: as it stands. */
export const PositionField = ({rig, value, chosen}) => rig?.positions.length > 0 && html`<label>Position of the board
  <select value=${value ?? ""} onChange=${(event) => chosen(event.target.value === "" ? null : Number(event.target.value))}>
    <option value="">Where it is now</option>
    ${rig.positions.map((name, index) => html`<option value=${index}>${name}</option>`)}
  </select></label>`;
