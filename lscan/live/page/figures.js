// The figures shown of every picture, their verdicts, and what the verdicts mean.
//
// Each limit is written once: the verdict uses it and the legend names it.

import { advise } from "./advice.js";
import { BOARD_FIGURES } from "./boardfigures.js";
import { gradeOfGreat, gradeOfSmall } from "./grades.js";
import { measured } from "./measured.js";
import { fixed } from "./page.js";
import { STRIPE_FIGURES } from "./stripefigures.js";

const CLIPPED_PERCENT = { good: 0.5, bad: 5 };
const FOCUS_PERCENT = { good: 95, bad: 80 };
const RATE_HZ = { good: 10, bad: 3 };

function clippedPercent(f) {
  if (f.mode === "board") return f.saturated_percent;
  return f.stripe?.found ? (100 * f.stripe.clipped) / f.stripe.found : null;
}

// Only of use to whoever turns the lens: no bar is to be filled by anybody else.
const focusShare = (f) =>
  f.phase === "alignment" && f.focus_best > 0 ? f.focus / f.focus_best : null;

// name, title, unit; mode: the only one it is shown in; show(frame): the number; judge(frame,
// before): grade and verdict, those of the frame before given; meter(frame): a share to be shown
// as a bar; legend: what the verdict means.
export const FIGURES = [
  {
    name: "saturation",
    title: "Saturation",
    unit: "%",
    show: (f) => fixed(clippedPercent(f), 1),
    judge(f) {
      const percent = clippedPercent(f);
      if (percent === null) return ["", ""];
      const grade = gradeOfSmall(percent, CLIPPED_PERCENT);
      const some = f.mode === "board" ? "pixels" : f.stripe.axis;
      if (grade === "good") return [grade, percent > 0 ? `a few ${some} clipped` : "not clipped"];
      const fault = `${grade === "fair" ? "a little" : "too"} bright`;
      return [grade, advise(f, "exposure", fault, "shorten the exposure")];
    },
    legend:
      "Share of the stripe, or with a board of the whole picture, whose brightness is clipped. " +
      "What is clipped has lost its top, and its centre is biased: good up to " +
      `${CLIPPED_PERCENT.good} %, too bright above ${CLIPPED_PERCENT.bad} %.`,
  },
  ...STRIPE_FIGURES,
  ...BOARD_FIGURES,
  {
    name: "focus",
    title: "Focus, share of the best",
    unit: "%",
    show: (f) => fixed(focusShare(f) && 100 * focusShare(f), 0),
    meter: (f) => focusShare(f) ?? 0,
    judge(f) {
      if (f.phase !== "alignment") return ["", "for alignment; leave the optics as they are"];
      if (focusShare(f) === null) return ["", ""];
      const grade = gradeOfGreat(100 * focusShare(f), FOCUS_PERCENT);
      if (grade === "good") return [grade, "at its best"];
      return [grade, advise(f, "optics", "not sharp", "turn the lens until the bar is full")];
    },
    legend:
      "In alignment: sharpness beside the sharpest picture since the head last moved. Turn the " +
      `lens through the best place and back to it: good from ${FOCUS_PERCENT.good} %, bad under ` +
      `${FOCUS_PERCENT.bad} %. A calibration and a scan hold for the lens as it was.`,
  },
  {
    name: "rate",
    title: "Pictures shown",
    unit: "/s",
    show: () => fixed(measured.rateHz, 1),
    judge(f) {
      const words = `${fixed(f.rate_hz, 1)} measured, camera ${fixed(f.camera_hz, 1)}`;
      return [gradeOfGreat(measured.rateHz, RATE_HZ), words];
    },
    legend:
      "Pictures drawn here per second, measured by the server, and sent by the camera: good from " +
      `${RATE_HZ.good} drawn, bad under ${RATE_HZ.bad}. A scan does not wait for them.`,
  },
  {
    name: "exposure",
    title: "Exposure",
    unit: "ms",
    show: (f) => fixed(f.exposure_ms, 2),
    judge: () => ["", "as the camera reports it"],
    legend: "Of the rig file's [camera] section; restart with another value to change it.",
  },
  {
    name: "track",
    title: "Track",
    unit: "mm",
    show: (f) => fixed(f.position_mm, 2),
    judge: (f) => ["", f.position_mm === null ? "not known" : ""],
    legend: "The position that the track reports.",
  },
];
