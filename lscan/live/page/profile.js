// The profile: height z over x, in mm, as the calibration turns the stripe into it.

import { limits, plotWindow, ticks } from "./axes.js";
import { COLOURS } from "./colours.js";
import { measured } from "./measured.js";
import { $ } from "./page.js";

const profile = $("profile").getContext("2d");
let kept = null; // limits of the axes in mm, kept while they fit, so that the axes do not move

/** Plot the points of a frame's profile; without a calibration there are none, and a notice. */
export function drawProfile(points) {
  const { canvas } = profile;
  const ratio = window.devicePixelRatio;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  profile.setTransform(ratio, 0, 0, ratio, 0, 0);
  profile.clearRect(0, 0, width, height);
  profile.font = "12px system-ui, sans-serif";
  if (!points) {
    drawNotice("no calibration: take a board picture", width, height);
    return;
  }
  kept = { x: limits(points.x_mm, kept?.x), z: limits(points.z_mm, kept?.z) };
  const plot = plotWindow(kept.x, kept.z, width, height, $("equal").checked);
  const { left, right, top, bottom } = plot;
  const toX = (x) => left + ((x - plot.x[0]) / (plot.x[1] - plot.x[0])) * (right - left);
  const toY = (z) => bottom - ((z - plot.z[0]) / (plot.z[1] - plot.z[0])) * (bottom - top);
  drawAxes(plot, toX, toY);
  profile.fillStyle = COLOURS.accent;
  points.x_mm.forEach((x, index) => {
    const z = points.z_mm[index];
    if (x !== null && z !== null) profile.fillRect(toX(x) - 1, toY(z) - 1, 2, 2);
  });
  measured.plot = plot;
}

function drawNotice(text, width, height) {
  profile.fillStyle = COLOURS.muted;
  profile.textAlign = "center";
  profile.textBaseline = "middle";
  profile.fillText(text, width / 2, height / 2);
  measured.plot = null;
}

function drawAxes(plot, toX, toY) {
  const { left, right, top, bottom } = plot;
  profile.lineWidth = 1;
  profile.strokeStyle = COLOURS.rule;
  profile.fillStyle = COLOURS.muted;
  profile.beginPath();
  profile.textAlign = "center";
  profile.textBaseline = "top";
  for (const [value, text] of ticks(plot.x, (right - left) / 70)) {
    const at = Math.round(toX(value)) + 0.5;
    profile.moveTo(at, top);
    profile.lineTo(at, bottom);
    profile.fillText(text, at, bottom + 5);
  }
  profile.textAlign = "right";
  profile.textBaseline = "middle";
  for (const [value, text] of ticks(plot.z, (bottom - top) / 34)) {
    const at = Math.round(toY(value)) + 0.5;
    profile.moveTo(left, at);
    profile.lineTo(right, at);
    profile.fillText(text, left - 6, at);
  }
  profile.stroke();
  profile.fillStyle = COLOURS.ink;
  profile.textBaseline = "bottom";
  profile.fillText("x in mm", right, bottom + 34);
  profile.textAlign = "left";
  profile.fillText("z in mm", 4, top - 10); // above the label of the highest tick
  profile.strokeStyle = COLOURS.muted;
  profile.strokeRect(left + 0.5, top + 0.5, right - left - 1, bottom - top - 1);
}
