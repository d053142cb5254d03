// The figures of the stripe and its profile, their verdicts, and what the verdicts mean.

import { gradeOfGreat, gradeOfSmall } from "./grades.js";
import { fixed } from "./page.js";

const SNR = { good: 15, bad: 8 };
const WIDTH_PX = { thin: 2, good: 8, bad: 14 };
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
      if (grade === "fair") return [grade, "weak: lengthen the exposure"];
      return [grade, "lost in noise: lengthen the exposure or darken the room"];
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
    judge(f) {
      const width = f.stripe?.width_px ?? null;
      if (width === null) return ["", ""];
      if (width < WIDTH_PX.thin) return ["fair", "very thin: open the lens or widen the sheet"];
      const grade = gradeOfSmall(width, WIDTH_PX);
      if (grade === "good") return [grade, "sharp"];
      const fault = grade === "fair" ? "wide" : "blurred";
      return [grade, `${fault}: focus the lens, narrow the sheet`];
    },
    legend:
      "Median full width at half height: good from " +
      `${WIDTH_PX.thin} to ${WIDTH_PX.good} px. Under that the pixels are too coarse for the ` +
      "stripe and pull its centre to themselves; over it edges are rounded off, badly above " +
      `${WIDTH_PX.bad} px.`,
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
      return ["fair", "not calibrated: take a board picture"];
    },
    legend:
      "Standard uncertainty of a point of the profile, as the calibration and the noise give it; " +
      "none without a calibration.",
  },
];
