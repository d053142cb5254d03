// The camera's picture with the stripe or the control points drawn on it.

import { COLOURS } from "./colours.js";
import { $ } from "./page.js";

const picture = $("picture").getContext("2d", { alpha: false });

/** Draw the picture of a frame and what was found in it. */
export function drawPicture(bitmap, f) {
  const { canvas } = picture;
  if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
    canvas.width = bitmap.width;
    canvas.height = bitmap.height;
  }
  picture.setTransform(1, 0, 0, 1, 0, 0);
  picture.drawImage(bitmap, 0, 0);
  // Pixel centres are whole numbers in the data; in the canvas they are at halves.
  picture.setTransform(1, 0, 0, 1, 0.5, 0.5);
  const thick = Math.max(2, bitmap.width / 320);
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
