// The camera's picture with the stripe or the control points drawn on it, whole or magnified.

import { COLOURS } from "./colours.js";
import { $ } from "./page.js";

const MAGNIFIED = 4;
const picture = $("picture").getContext("2d", { alpha: false });
const whole = { x: 0, y: 0, scale: 1 };
let seen = whole; // the part of the picture that is shown: its corner in px, and how magnified
let along = 0.5; // where along the stripe the magnified part lies, as a share of the picture

/** Let a click on the picture choose where along the stripe it is magnified. */
export function followClicks() {
  const { canvas } = picture;
  canvas.addEventListener("click", ({ offsetX, offsetY }) => {
    const { width, height, clientWidth, clientHeight } = canvas;
    const shown = Math.min(clientWidth / width, clientHeight / height); // fitted into its element
    const u = seen.x + ((offsetX - clientWidth / 2) / shown + width / 2) / seen.scale;
    const v = seen.y + ((offsetY - clientHeight / 2) / shown + height / 2) / seen.scale;
    along = canvas.dataset.axis === "rows" ? v / height : u / width;
  });
}

/** The part to be shown: magnified about the stripe, it is kept while the stripe is in it. */
function partOf(f, { width, height }) {
  if (!$("zoom").checked || f.mode !== "stripe" || !f.stripe?.found) return whole;
  const { axis, centre_px } = f.stripe;
  const at = along * centre_px.length;
  const near = (index) => (centre_px[index] === null ? Infinity : Math.abs(index - at));
  const index = centre_px.reduce((best, _, one) => (near(one) < near(best) ? one : best), 0);
  const [u, v] = axis === "columns" ? [index, centre_px[index]] : [centre_px[index], index];
  const [x, y] = [u - width / MAGNIFIED / 2, v - height / MAGNIFIED / 2].map(Math.round);
  const still = seen.scale > 1 && Math.abs(x - seen.x) < width / MAGNIFIED / 4;
  if (still && Math.abs(y - seen.y) < height / MAGNIFIED / 4) return seen;
  return { x, y, scale: MAGNIFIED };
}

/** Draw the picture of a frame and what was found in it. */
export function drawPicture(bitmap, f) {
  const { canvas } = picture;
  if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
    canvas.width = bitmap.width;
    canvas.height = bitmap.height;
  }
  canvas.dataset.axis = f.stripe?.axis ?? "";
  seen = partOf(f, bitmap);
  const { x, y, scale } = seen;
  picture.setTransform(1, 0, 0, 1, 0, 0);
  picture.clearRect(0, 0, canvas.width, canvas.height);
  picture.imageSmoothingEnabled = false;
  picture.setTransform(scale, 0, 0, scale, -scale * x, -scale * y);
  picture.drawImage(bitmap, 0, 0);
  // Pixel centres are whole numbers in the data; in the canvas they are at halves.
  picture.setTransform(scale, 0, 0, scale, scale * (0.5 - x), scale * (0.5 - y));
  const thick = Math.max(2, bitmap.width / 320) / scale;
  if (f.mode === "stripe" && f.stripe) drawStripe(f.stripe, thick);
  if (f.mode === "board" && f.board) drawMarks(f.board.marks_px, thick);
}

/** One dot a column (or row), as wide as the column: neighbours join into a line. */
function drawStripe({ axis, centre_px, clipped_at }, thick) {
  const clipped = new Set(clipped_at ?? []);
  centre_px.forEach((centre, index) => {
    if (centre === null) return;
    picture.fillStyle = clipped.has(index) ? COLOURS.clipped : COLOURS.stripe;
    const along = index - 0.5;
    const across = centre - thick / 2;
    if (axis === "columns") picture.fillRect(along, across, 1, thick);
    else picture.fillRect(across, along, thick, 1);
  });
}

function drawMarks(marks, thick) {
  const arm = 4 * thick;
  picture.strokeStyle = COLOURS.mark;
  picture.lineWidth = thick;
  picture.beginPath();
  for (const [u, v] of marks) {
    picture.moveTo(u - arm, v);
    picture.lineTo(u + arm, v);
    picture.moveTo(u, v - arm);
    picture.lineTo(u, v + arm);
  }
  picture.stroke();
}
