// The figures of the stripe and its profile, their verdicts, and what the verdicts mean.

import { advise } from "./advice.js";
import { gradeOfGreat, gradeOfSmall, steady } from "./grades.js";
import { fixed, signed } from "./page.js";

const SNR = { good: 15, bad: 8 };
const WIDTH_PX = { thin: 2.5, good: 4, bad: 8 }; // the README says the same
const STEADY_PERCENT = 5; // by which a width passes a limit before its verdict turns
const FOUND_PERCENT = { good: 95, bad: 50 };

const REASONS = {
  NO_PEAK: "no peak",
  SATURATED: "clipped",
  AT_BORDER: "at the border",
  OUT_OF_BOARD: "outside the board",
  OUT_OF_VIEW: "out of view",
  OCCLUDED: "hidden",
  AMBIGUOUS: "several lines",
};

// Of each kind of width its grade, what is to be said, and what to do about it.
const WIDTHS = {
  thin: ["fair", "thin for a colour camera", "open the lens or widen the sheet"],
  good: ["good", "sharp"],
  wide: ["fair", "wide", "focus the lens, narrow the sheet"],
  blurred: ["bad", "blurred", "focus the lens, narrow the sheet"],
};

function widthKind(width) {
  if (width < WIDTH_PX.thin) return "thin";
  return { good: "good", fair: "wide", bad: "blurred" }[gradeOfSmall(width, WIDTH_PX)];
}

const degrees = (slope) => (-180 / Math.PI) * Math.atan(slope); // v runs down

const missing = ({ status }) =>
  Object.entries(status)
    .filter(([name, count]) => count > 0 && name in REASONS && name !== "SATURATED")
    .map(([name, count]) => `${REASONS[name]} ${count}`)
    .join(", ");

export const STRIPE_FIGURES = [
  {
    name: "snr",
    title: "Signal to noise",
    mode: "stripe",
    show: (f) => fixed(f.stripe?.snr, 0),
    judge(f) {
      const snr = f.stripe?.snr ?? null;
      if (snr === null) return ["", ""];
      const grade = gradeOfGreat(snr, SNR);
      if (grade === "good") return [grade, "clear"];
      if (grade === "fair") return [grade, advise(f, "exposure", "weak", "lengthen the exposure")];
      const todo = "lengthen the exposure or darken the room";
      return [grade, advise(f, "exposure", "lost in noise", todo)];
    },
    legend:
      `Median peak over the noise: good from ${SNR.good}, where the noise moves the centre of a ` +
      "stripe 5 px wide by about 0.1 px (Cramér–Rao bound of a Gaussian); bad under " +
      `${SNR.bad}, where columns are lost.`,
  },
  {
    name: "width",
    title: "Stripe width",
    unit: "px",
    mode: "stripe",
    show: (f) => fixed(f.stripe?.width_px, 1),
    judge(f, before) {
      const width = f.stripe?.width_px ?? null;
      if (width === null) return ["", ""];
      const kind = steady(widthKind, width, before?.[2], STEADY_PERCENT);
      const [grade, fault, todo] = WIDTHS[kind];
      return [grade, todo ? advise(f, "optics", fault, todo) : fault, kind];
    },
    legend:
      "Median full width at half height: good from " +
      `${WIDTH_PX.thin} to ${WIDTH_PX.good} px. Under that a colour camera, which has red on ` +
      "every other row alone, pulls the centre to those rows; over it noise moves the centre and " +
      `edges are rounded off, badly above ${WIDTH_PX.bad} px.`,
  },
  {
    name: "slope",
    title: "Slope of the stripe",
    unit: "°",
    mode: "stripe",
    show: (f) => (f.stripe?.slope == null ? "–" : signed(degrees(f.stripe.slope), 2)),
    judge(f) {
      const slope = f.stripe?.slope ?? null;
      return ["", slope === null ? "" : `${fixed(100 * Math.abs(slope), 1)} px in 100 px`];
    },
    legend:
      "Of the straight line through the stripe against the picture's rows, + where its right end " +
      "is the higher; against the columns, + where its upper end is farther right, of a stripe " +
      "found in rows. 0 on a level target where sheet and camera are level with it.",
  },
  {
    name: "found",
    title: "Stripe found",
    mode: "stripe",
    show: (f) => (f.stripe ? `${f.stripe.found} of ${f.stripe.of}` : "–"),
    judge(f) {
      if (!f.stripe) return ["", ""];
      const grade = gradeOfGreat((100 * f.stripe.found) / f.stripe.of, FOUND_PERCENT);
      if (grade === "good") return [grade, `${f.stripe.axis}, nearly all`];
      return [grade, missing(f.stripe) || `${f.stripe.axis} without a stripe`];
    },
    legend:
      "Columns (or rows) of the picture with a stripe: good from " +
      `${FOUND_PERCENT.good} %, bad under ${FOUND_PERCENT.bad} %.`,
  },
  {
    name: "sigma",
    title: "Profile σ",
    unit: "mm",
    mode: "stripe",
    show: (f) => fixed(f.profile?.sigma_mm, 3),
    judge(f) {
      if (f.profile) return ["", "standard uncertainty, median"];
      return ["fair", advise(f, "calibration", "not calibrated", "take a board picture")];
    },
    legend:
      "Standard uncertainty of a point of the profile, as the calibration and the noise give it; " +
      "none without a calibration.",
  },
];
