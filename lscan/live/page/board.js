// The board before the sheet: a drawing of its corners, and what to do with it.

import { holds } from "./advice.js";
import { $, fixed, signed, write } from "./page.js";

export const ENOUGH_MM = 0.5; // a board nearer to the sheet than this is well placed
export const FAR_MM = 2; // a board farther from it, surely so, is badly placed
export const ENOUGH_DEG = 0.1; // 0.4 mm at the edge of a board 0.5 m wide

/** Whether a distance or an angle is worth a turn of a screw: more than enough, and certain. */
export const matters = (value, sigma, enough) =>
  Math.abs(value) > Math.max(enough, 2 * (sigma ?? 0));

/** What brings the board into the sheet, one move each for distance and tilts that matter. */
function movesInto({ distance_mm, sigma_mm, ...tilt }) {
  const size = (value) => fixed(Math.abs(value), 1);
  const moves = [];
  if (matters(distance_mm, sigma_mm, ENOUGH_MM)) {
    const way = distance_mm > 0 ? "towards" : "away from";
    moves.push(`move the board ${size(distance_mm)} mm ${way} the camera`);
  }
  if (matters(tilt.tilt_x_deg, tilt.tilt_x_sigma_deg, ENOUGH_DEG)) {
    const way = tilt.tilt_x_deg > 0 ? "back" : "forward";
    moves.push(`lean its top ${way} by ${size(tilt.tilt_x_deg)}°`);
  }
  if (matters(tilt.tilt_z_deg, tilt.tilt_z_sigma_deg, ENOUGH_DEG)) {
    const way = tilt.tilt_z_deg > 0 ? "forward" : "back";
    moves.push(`turn its right side ${way} by ${size(tilt.tilt_z_deg)}°`);
  }
  return moves;
}

/** What to do with the board, in words. */
function advice(f) {
  const { board } = f;
  if (!board) return "Looking for the board …";
  if (board.message) return board.message;
  if (!board.offset) return board.offset_message ?? "";
  const moves = movesInto(board.offset);
  const within = fixed(Math.max(ENOUGH_MM, 2 * board.offset.sigma_mm), 1);
  if (!moves.length) return `The board lies in the sheet, within ${within} mm.`;
  if (!holds(f, "board")) return "";
  const text = moves.join("; ");
  return `${text[0].toUpperCase()}${text.slice(1)}.`;
}

/** Show the board's distance from the sheet, in words and at its corners. */
export function showBoard(f) {
  const { board } = f; // null before it was looked for
  const offset = board?.offset ?? null;
  write($("board-advice"), advice(f));
  write($("board-age"), board ? `read ${fixed(board.age_s, 1)} s ago` : "");
  $("corners").dataset.known = offset !== null;
  $("corners").querySelectorAll("g").forEach((corner, index) => {
    const value = offset ? offset.corners_mm[index] : 0;
    corner.dataset.side = !offset || Math.abs(value) < 0.05 ? "" : value < 0 ? "front" : "behind";
    write(corner.querySelector("text"), offset ? signed(value, 1) : "");
  });
  const [middle, unit] = $("corners").querySelectorAll(".middle, .unit");
  const known = offset && `${signed(offset.distance_mm, 1)} ± ${fixed(offset.sigma_mm, 1)} mm`;
  write(middle, known ?? "");
  const side = offset && (offset.distance_mm < 0 ? "in front of the sheet" : "behind the sheet");
  write(unit, side ?? "distance not known");
}
