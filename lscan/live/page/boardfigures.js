// The figures of the board, their verdicts, and what the verdicts mean.

import { ENOUGH_DEG, ENOUGH_MM, FAR_MM, matters } from "./board.js";
import { gradeOfSmall } from "./grades.js";
import { fixed, signed } from "./page.js";

const RESIDUAL_PX = { good: 0.2, bad: 0.5 };

export const BOARD_FIGURES = [
  {
    name: "marks",
    title: "Control points",
    mode: "board",
    show: (f) => (f.board ? `${f.board.found} of ${f.board.expected}` : "–"),
    judge(f) {
      if (!f.board) return ["", "looking for the board"];
      if (f.board.found === f.board.expected) return ["good", "all found"];
      if (f.board.found === 0) return ["bad", "no board found"];
      return ["fair", `${f.board.expected - f.board.found} missing: covered, cut off or in glare`];
    },
    legend:
      "Control points of the board found in the picture, of those the rig file names: good " +
      "where all are, bad where none is.",
  },
  {
    name: "residual",
    title: "Residual, rms",
    unit: "px",
    mode: "board",
    show: (f) => fixed(f.board?.residual_rms_px, 2),
    judge(f) {
      const rms = f.board?.residual_rms_px ?? null;
      if (rms === null) return ["", ""];
      const { residual_rms_mm: mm, residual_max_px: largest } = f.board;
      const onBoard = mm === null ? "" : `${fixed(mm, 2)} mm, `;
      return [gradeOfSmall(rms, RESIDUAL_PX), `${onBoard}largest ${fixed(largest, 2)} px`];
    },
    legend:
      "How far the control points lie from where the plane map puts them. Webcams read boards to " +
      `0.1 to 0.2 px: good up to ${RESIDUAL_PX.good} px; above ${RESIDUAL_PX.bad} px, which is ` +
      "bad, the board is bent, blurred, or another one.",
  },
  {
    name: "distance",
    title: "Board from the sheet",
    unit: "mm",
    mode: "board",
    show: (f) => (f.board?.offset ? signed(f.board.offset.distance_mm, 1) : "–"),
    judge(f) {
      const offset = f.board?.offset;
      if (!offset) return ["", ""];
      const good = !matters(offset.distance_mm, offset.sigma_mm, ENOUGH_MM);
      const far = Math.abs(offset.distance_mm) > FAR_MM;
      return [good ? "good" : far ? "bad" : "fair", `± ${fixed(offset.sigma_mm, 1)} mm (σ)`];
    },
    legend:
      "Middle of the board in front of (−) or behind (+) the laser sheet, as the camera sees it. " +
      `Good within ${ENOUGH_MM} mm or twice its standard uncertainty σ; beyond these bad where ` +
      `also beyond ${FAR_MM} mm.`,
  },
  {
    name: "tilt",
    title: "Tilt about x, z",
    unit: "°",
    mode: "board",
    show(f) {
      const offset = f.board?.offset;
      return offset ? `${signed(offset.tilt_x_deg, 1)}, ${signed(offset.tilt_z_deg, 1)}` : "–";
    },
    judge(f) {
      const offset = f.board?.offset;
      if (!offset) return ["", ""];
      const leans =
        matters(offset.tilt_x_deg, offset.tilt_x_sigma_deg, ENOUGH_DEG) ||
        matters(offset.tilt_z_deg, offset.tilt_z_sigma_deg, ENOUGH_DEG);
      return leans ? ["fair", "leans out of the sheet"] : ["good", "upright in the sheet"];
    },
    legend:
      "How the board leans out of the sheet: about the horizontal x (+: its top towards the " +
      "camera) and about the upright z (+: its right side behind). Good within " +
      `${ENOUGH_DEG}° or 2 σ.`,
  },
];
