// The axes of a plot: limits that are kept while they fit, ticks at round numbers.

import { fixed } from "./page.js";

const MARGIN = { left: 52, right: 14, top: 28, bottom: 36 };

/** Smallest 1, 2 or 5 times a power of ten that cuts the span into at most `most` parts. */
function tickStep(span, most) {
  const least = span / most;
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= least);
}

/** Limits round the values with a tenth of room; the old ones where the values still fill them. */
export function limits(values, old) {
  let low = Infinity;
  let high = -Infinity;
  for (const value of values)
    if (value !== null) {
      low = Math.min(low, value);
      high = Math.max(high, value);
    }
  if (low > high) return old ?? [-1, 1];
  const span = Math.max(high - low, 1);
  if (old && low >= old[0] && high <= old[1] && span > 0.5 * (old[1] - old[0])) return old;
  const middle = (low + high) / 2;
  const step = tickStep(span, 20);
  const ends = [(middle - 0.6 * span) / step, (middle + 0.6 * span) / step];
  return [Math.floor(ends[0]) * step, Math.ceil(ends[1]) * step];
}

/** The plot's window in mm and px, after the size of the canvas and the scales asked for. */
export function plotWindow(x, z, width, height, equal) {
  const box = {
    left: MARGIN.left,
    right: width - MARGIN.right,
    top: MARGIN.top,
    bottom: height - MARGIN.bottom,
    x: [...x],
    z: [...z],
  };
  if (equal) {
    const across = (x[1] - x[0]) / (box.right - box.left);
    const mmPerPx = Math.max(across, (z[1] - z[0]) / (box.bottom - box.top));
    const widen = (pair, pixels) => {
      const more = (mmPerPx * pixels - (pair[1] - pair[0])) / 2;
      return [pair[0] - more, pair[1] + more];
    };
    box.x = widen(x, box.right - box.left);
    box.z = widen(z, box.bottom - box.top);
  }
  return box;
}

/** [value, text] of each tick between the limits, at most so many. */
export function ticks([low, high], most) {
  const step = tickStep(high - low, Math.max(2, most));
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const found = [];
  for (let index = Math.ceil(low / step - 1e-9); index * step <= high + 1e-9 * step; index++)
    found.push([index * step, fixed(index * step, digits).replace(/^−(0\.?0*)$/, "$1")]);
  return found;
}
