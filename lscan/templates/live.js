// The live page: draws each picture with what was measured in it, and sends the buttons' commands.
//
// Two loops talk to the server.  One asks for the next picture when the last is drawn, so that
// a slow browser holds up itself and nobody else; the other asks for the state of camera, track
// and scan.  Everything shown comes from these two answers.

const $ = (id) => document.getElementById(id);
const RETRY_MS = 1000;
const STATE_MS = 500;
const READABLE_MS = 200; // numbers that change faster than this cannot be read
const RATE_WINDOW_MS = 2000;
const ENOUGH_MM = 0.5; // a board nearer to the sheet than this is well placed
const ENOUGH_DEG = 0.1; // 0.4 mm at the edge of a board 0.5 m wide

// For whoever measures the page: pictures drawn, those of them with stripe and profile, the
// number of the last, how many a second, and the window of the plot in mm and px.
window.lscan = { framesDrawn: 0, profilesDrawn: 0, lastNumber: 0, rateHz: 0, plot: null };
let state = null;
let frame = null;

// ---- words and numbers ----------------------------------------------------------------------

const fixed = (value, digits) =>
  value === null || value === undefined ? "–" : value.toFixed(digits).replace("-", "−");

const signed = (value, digits) => (Number(value.toFixed(digits)) > 0 ? "+" : "") + fixed(value, digits);

const clock = (seconds) =>
  `${Math.floor(seconds / 60)}:${String(Math.floor(seconds % 60)).padStart(2, "0")}`;

const REASONS = {
  NO_PEAK: "no peak",
  SATURATED: "clipped",
  AT_BORDER: "at the border",
  OUT_OF_BOARD: "outside the board",
  OUT_OF_VIEW: "out of view",
  OCCLUDED: "hidden",
  AMBIGUOUS: "several lines",
};

/** Write text only where it changed: an unchanged live region must not be read out again. */
function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

// ---- the numbers, their verdicts and what the verdicts mean ---------------------------------

const clippedPercent = (f) =>
  f.mode === "board" ? f.saturated_percent : f.stripe?.found ? (100 * f.stripe.clipped) / f.stripe.found : null;

const missing = ({ status }) =>
  Object.entries(status)
    .filter(([name, count]) => count > 0 && name in REASONS && name !== "SATURATED")
    .map(([name, count]) => `${REASONS[name]} ${count}`)
    .join(", ");

// name, title, modes; show(frame): the number; judge(frame): grade and verdict; legend: why.
const NUMBERS = [
  {
    name: "saturation",
    title: "Saturation",
    unit: "%",
    show: (f) => fixed(clippedPercent(f), 1),
    judge(f) {
      const percent = clippedPercent(f);
      if (percent === null) return ["", ""];
      if (percent <= 0.5) return ["good", "not clipped"];
      if (percent <= 5) return ["fair", "a little bright: shorten the exposure"];
      return ["bad", "too bright: shorten the exposure"];
    },
    legend:
      "Share of the stripe (board: of the picture) whose brightness is clipped. A clipped peak " +
      "has lost its top, and its centre is biased: good up to 0.5 %, too bright above 5 %.",
  },
  {
    name: "snr",
    title: "Signal to noise",
    mode: "stripe",
    show: (f) => fixed(f.stripe?.snr, 0),
    judge(f) {
      const snr = f.stripe?.snr ?? null;
      if (snr === null) return ["", ""];
      if (snr >= 15) return ["good", "clear"];
      if (snr >= 8) return ["fair", "weak: lengthen the exposure"];
      return ["bad", "lost in noise: lengthen the exposure or darken the room"];
    },
    legend:
      "Median peak over the noise. At 15 the noise moves the centre of a stripe 5 px wide by " +
      "about 0.1 px (Cramér–Rao bound of a Gaussian); under 8 columns are lost.",
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
      if (width < 2) return ["fair", "very thin: open the lens or widen the sheet"];
      if (width <= 8) return ["good", "sharp"];
      if (width <= 14) return ["fair", "wide: focus the lens, narrow the sheet"];
      return ["bad", "blurred: focus the lens, narrow the sheet"];
    },
    legend:
      "Median full width at half height. Under 2 px the pixels are too coarse for the stripe " +
      "and pull its centre to themselves; over 8 px edges are rounded off.",
  },
  {
    name: "found",
    title: "Stripe found",
    mode: "stripe",
    show: (f) => (f.stripe ? `${f.stripe.found} of ${f.stripe.of}` : "–"),
    judge(f) {
      if (!f.stripe) return ["", ""];
      const share = f.stripe.found / f.stripe.of;
      if (share >= 0.95) return ["good", `${f.stripe.axis}, nearly all`];
      return [share >= 0.5 ? "fair" : "bad", missing(f.stripe) || `${f.stripe.axis} without a stripe`];
    },
    legend: "Columns (or rows) of the picture with a stripe: good from 95 %, bad under half.",
  },
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
    legend: "Control points of the board found in the picture, of those the rig file names.",
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
      const mm = f.board.residual_rms_mm;
      const more = `${mm === null ? "" : `${fixed(mm, 2)} mm, `}largest ${fixed(f.board.residual_max_px, 2)} px`;
      return [rms <= 0.2 ? "good" : rms <= 0.5 ? "fair" : "bad", more];
    },
    legend:
      "How far the control points lie from where the plane map puts them. Webcams read boards to " +
      "0.1 to 0.2 px; above 0.5 px the board is bent, blurred, or another one.",
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
      const off = matters(offset.distance_mm, offset.sigma_mm, ENOUGH_MM);
      return [!off ? "good" : Math.abs(offset.distance_mm) <= 2 ? "fair" : "bad", `± ${fixed(offset.sigma_mm, 1)} mm (σ)`];
    },
    legend:
      "Middle of the board in front of (−) or behind (+) the laser sheet, as the camera sees it. " +
      "Good within 0.5 mm or twice its standard uncertainty σ, bad beyond 2 mm.",
  },
  {
    name: "tilt",
    title: "Tilt about x, z",
    unit: "°",
    mode: "board",
    show: (f) =>
      f.board?.offset ? `${signed(f.board.offset.tilt_x_deg, 1)}, ${signed(f.board.offset.tilt_z_deg, 1)}` : "–",
    judge(f) {
      const offset = f.board?.offset;
      if (!offset) return ["", ""];
      const off =
        matters(offset.tilt_x_deg, offset.tilt_x_sigma_deg, ENOUGH_DEG) ||
        matters(offset.tilt_z_deg, offset.tilt_z_sigma_deg, ENOUGH_DEG);
      return off ? ["fair", "leans out of the sheet"] : ["good", "upright in the sheet"];
    },
    legend:
      "How the board leans out of the sheet: about the horizontal x (+: its top towards the " +
      "camera) and about the upright z (+: its right side behind). Good within 0.1° or 2 σ.",
  },
  {
    name: "focus",
    title: "Focus, of the best",
    unit: "%",
    show: (f) => (f.focus_best > 0 ? fixed((100 * f.focus) / f.focus_best, 0) : "–"),
    meter: (f) => (f.focus_best > 0 ? f.focus / f.focus_best : 0),
    judge(f) {
      if (!(f.focus_best > 0)) return ["", ""];
      const share = f.focus / f.focus_best;
      if (share >= 0.95) return ["good", "at its best"];
      return [share >= 0.8 ? "fair" : "bad", "turn the lens until the bar is full"];
    },
    legend:
      "Sharpness beside the sharpest picture since the page's camera was opened. Turn the lens " +
      "through the best place and back to it: good from 95 %.",
  },
  {
    name: "rate",
    title: "Pictures shown",
    unit: "/s",
    show: () => fixed(window.lscan.rateHz, 1),
    judge(f) {
      const words = `${fixed(f.rate_hz, 1)} measured, camera ${fixed(f.camera_hz, 1)}`;
      return [window.lscan.rateHz >= 10 ? "good" : window.lscan.rateHz >= 3 ? "fair" : "bad", words];
    },
    legend: "Pictures drawn here per second, measured by the server, and sent by the camera.",
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
    name: "sigma",
    title: "Profile σ",
    unit: "mm",
    mode: "stripe",
    show: (f) => fixed(f.profile?.sigma_mm, 3),
    judge: (f) => (f.profile ? ["", "standard uncertainty, median"] : ["fair", "not calibrated: take a board picture"]),
    legend: "Standard uncertainty of a point of the profile, as the calibration and the noise give it.",
  },
  {
    name: "track",
    title: "Track",
    unit: "mm",
    show: (f) => fixed(f.position_mm, 2),
    judge: (f) => ["", f.position_mm === null ? "not known" : ""],
    legend: "Where the track says that the head stands.",
  },
];

function element(tag, className, text = "") {
  const made = document.createElement(tag);
  made.className = className;
  made.textContent = text;
  return made;
}

/** One tile and one line of the legend for each number. */
function buildNumbers() {
  for (const number of NUMBERS) {
    const tile = element("div", number.mode ? `tile ${number.mode}-only` : "tile");
    const value = element("dd", "value");
    value.append(element("span", "number"), element("small", "", number.unit ? ` ${number.unit}` : ""));
    tile.append(element("dt", "", number.title), value);
    if (number.meter) {
      const meter = Object.assign(element("meter", ""), { max: 1, ariaLabel: number.title });
      const bar = element("dd", "");
      bar.append(meter);
      tile.append(bar);
    }
    tile.append(element("dd", "verdict"));
    tile.dataset.number = number.name;
    tile.title = number.legend;
    $("tiles").append(tile);
    const shown = number.mode ? `${number.mode}-only` : "";
    $("legend").append(element("dt", shown, number.title), element("dd", shown, number.legend));
    number.tile = tile;
  }
}

function showNumbers(f) {
  for (const { tile, show, judge, meter } of NUMBERS) {
    const [grade, verdict] = judge(f);
    tile.dataset.grade = grade;
    write(tile.querySelector(".number"), show(f));
    write(tile.querySelector(".verdict"), verdict);
    if (meter) tile.querySelector("meter").value = meter(f);
  }
  write($("position"), f.position_mm === null ? "" : `at ${fixed(f.position_mm, 2)} mm`);
  write($("caption"), `${f.size_px.join(" × ")} · picture ${f.number}`);
}

// ---- the picture ----------------------------------------------------------------------------

const COLOURS = {};

function readColours() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["stripe", "clipped", "mark", "ink", "muted", "rule", "accent"])
    COLOURS[name] = style.getPropertyValue(`--${name}`).trim();
}

const picture = $("picture").getContext("2d", { alpha: false });

function drawPicture(bitmap, f) {
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

// ---- the profile ----------------------------------------------------------------------------

const profile = $("profile").getContext("2d");
const MARGIN = { left: 52, right: 14, top: 16, bottom: 36 };
let shown = null; // limits of the plot, kept while they serve, so that the axes stand still

/** Smallest 1, 2 or 5 times a power of ten that cuts the span into at most `most` parts. */
function tickStep(span, most) {
  const least = span / most;
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= least);
}

/** Limits round the values with a tenth of room; the old ones where the values still fill them. */
function limits(values, old) {
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
  return [Math.floor((middle - 0.6 * span) / step) * step, Math.ceil((middle + 0.6 * span) / step) * step];
}

/** The plot's window in mm and px, after the size of the canvas and the scales asked for. */
function plotWindow(x, z, width, height, equal) {
  const box = {
    left: MARGIN.left,
    right: width - MARGIN.right,
    top: MARGIN.top,
    bottom: height - MARGIN.bottom,
    x: [...x],
    z: [...z],
  };
  if (equal) {
    const mmPerPx = Math.max((x[1] - x[0]) / (box.right - box.left), (z[1] - z[0]) / (box.bottom - box.top));
    const widen = (pair, pixels) => {
      const more = (mmPerPx * pixels - (pair[1] - pair[0])) / 2;
      return [pair[0] - more, pair[1] + more];
    };
    box.x = widen(x, box.right - box.left);
    box.z = widen(z, box.bottom - box.top);
  }
  return box;
}

function drawProfile(points) {
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
  shown = { x: limits(points.x_mm, shown?.x), z: limits(points.z_mm, shown?.z) };
  const plot = plotWindow(shown.x, shown.z, width, height, $("equal").checked);
  const toX = (x) => plot.left + ((x - plot.x[0]) / (plot.x[1] - plot.x[0])) * (plot.right - plot.left);
  const toY = (z) => plot.bottom - ((z - plot.z[0]) / (plot.z[1] - plot.z[0])) * (plot.bottom - plot.top);
  drawAxes(plot, toX, toY);
  profile.fillStyle = COLOURS.accent;
  points.x_mm.forEach((x, index) => {
    const z = points.z_mm[index];
    if (x !== null && z !== null) profile.fillRect(toX(x) - 1, toY(z) - 1, 2, 2);
  });
  window.lscan.plot = plot;
}

function drawNotice(text, width, height) {
  profile.fillStyle = COLOURS.muted;
  profile.textAlign = "center";
  profile.textBaseline = "middle";
  profile.fillText(text, width / 2, height / 2);
  window.lscan.plot = null;
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
  profile.fillText("z in mm", 4, top - 2);
  profile.strokeStyle = COLOURS.muted;
  profile.strokeRect(left + 0.5, top + 0.5, right - left - 1, bottom - top - 1);
}

function ticks([low, high], most) {
  const step = tickStep(high - low, Math.max(2, most));
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const found = [];
  for (let index = Math.ceil(low / step - 1e-9); index * step <= high + 1e-9 * step; index++)
    found.push([index * step, fixed(index * step, digits).replace(/^−(0\.?0*)$/, "$1")]);
  return found;
}

// ---- the board ------------------------------------------------------------------------------

/** Whether a distance or an angle is worth a turn of a screw: more than enough, and certain. */
const matters = (value, sigma, enough) => Math.abs(value) > Math.max(enough, 2 * (sigma ?? 0));

/** What to do with the board, in words. */
function advice(board) {
  if (!board) return "Looking for the board …";
  if (board.message) return board.message;
  if (!board.offset) return board.offset_message ?? "";
  const { distance_mm, sigma_mm, tilt_x_deg, tilt_x_sigma_deg, tilt_z_deg, tilt_z_sigma_deg } = board.offset;
  const moves = [];
  if (matters(distance_mm, sigma_mm, ENOUGH_MM))
    moves.push(`move the board ${fixed(Math.abs(distance_mm), 1)} mm ${distance_mm > 0 ? "towards" : "away from"} the camera`);
  if (matters(tilt_x_deg, tilt_x_sigma_deg, ENOUGH_DEG))
    moves.push(`lean its top ${tilt_x_deg > 0 ? "back" : "forward"} by ${fixed(Math.abs(tilt_x_deg), 1)}°`);
  if (matters(tilt_z_deg, tilt_z_sigma_deg, ENOUGH_DEG))
    moves.push(`turn its right side ${tilt_z_deg > 0 ? "forward" : "back"} by ${fixed(Math.abs(tilt_z_deg), 1)}°`);
  if (!moves.length) return `The board stands in the sheet, within ${fixed(Math.max(ENOUGH_MM, 2 * sigma_mm), 1)} mm.`;
  const text = moves.join("; ");
  return `${text[0].toUpperCase()}${text.slice(1)}.`;
}

function showBoard(board) {
  const offset = board?.offset ?? null;
  write($("board-advice"), advice(board));
  write($("board-age"), board ? `read ${fixed(board.age_s, 1)} s ago` : "");
  $("corners").dataset.known = offset !== null;
  $("corners").querySelectorAll("g").forEach((corner, index) => {
    const value = offset ? offset.corners_mm[index] : 0;
    corner.dataset.side = !offset || Math.abs(value) < 0.05 ? "" : value < 0 ? "front" : "behind";
    write(corner.querySelector("text"), offset ? signed(value, 1) : "");
  });
  const [middle, unit] = $("corners").querySelectorAll(".middle, .unit");
  write(middle, offset ? `${signed(offset.distance_mm, 1)} ± ${fixed(offset.sigma_mm, 1)} mm` : "");
  write(unit, !offset ? "distance not known" : offset.distance_mm < 0 ? "in front of the sheet" : "behind the sheet");
}

// ---- the state: what can be done now --------------------------------------------------------

const STATES = {
  idle: "ready",
  scanning: "scanning",
  paused: "paused",
  stopping: "stopping after this frame",
  done: "done",
  failed: "failed",
};
const faults = {};

/** Show a fault of one origin in the alert line, or take it away with "". */
function complain(origin, text) {
  faults[origin] = text || "";
  write($("alert"), Object.values(faults).filter(Boolean).join("\n"));
}

const moving = () => ["scanning", "stopping"].includes(state.scan.state);

function resumable({ scan }) {
  const unfinished = scan.folder !== null && scan.done < scan.planned;
  return ["paused", "failed"].includes(scan.state) || (["idle", "done"].includes(scan.state) && unfinished);
}

/** Enable exactly what the server would accept now. */
function showButtons() {
  const scan = state.scan.state;
  const free = !moving() && !state.task.name;
  const allowed = {
    start: free && scan !== "paused",
    name: free && scan !== "paused",
    pause: scan === "scanning",
    resume: free && resumable(state),
    stop: scan === "scanning" || scan === "paused",
    "mode-stripe": true,
    "mode-board": state.board,
    "take-board": state.board && free && scan !== "paused",
    laser: free,
    target: free,
    go: free,
  };
  const active = document.activeElement;
  for (const [id, may] of Object.entries(allowed)) $(id).disabled = !may;
  for (const button of document.querySelectorAll(".jog"))
    button.disabled = !free || state.track.position_mm === null;
  // A button that goes dead under the finger hands the focus to its neighbour.
  if (active?.disabled) active.closest(".buttons")?.querySelector("button:enabled")?.focus();
}

function showScan({ scan, plan }) {
  const stopping = scan.state === "stopping";
  write($("scan-state"), (stopping && scan.message) || STATES[scan.state]);
  const running = scan.state !== "idle" || scan.folder !== null;
  $("progress").value = running && scan.planned ? scan.done / scan.planned : 0;
  const parts = running
    ? [
        `${scan.done} of ${scan.planned} frames`,
        scan.left_s === null ? "" : `${clock(scan.left_s)} left`,
        `${clock(scan.elapsed_s)} gone`,
        scan.folder?.split("/").slice(-2).join("/"),
        scan.state === "failed" || stopping ? "" : scan.message,
      ]
    : [`${plan.frames} frames from ${plan.start_mm} mm, every ${plan.step_mm} mm`];
  $("scan-note").title = scan.folder ?? "";
  write($("scan-note"), parts.filter(Boolean).join(" · "));
  const percent = Math.round(100 * $("progress").value);
  document.title = moving() ? `${percent} % · lscan live` : "lscan live";
}

function showState(answer) {
  state = answer;
  const { camera, track, task } = state;
  write($("rig"), state.rig);
  const calibration = state.calibration ? state.calibration.split("/").pop() : "no calibration";
  write($("devices"), [`camera ${camera.driver}`, `track ${track.driver}`, calibration].join(" · "));
  document.body.dataset.mode = state.mode;
  $("mode-stripe").ariaPressed = String(state.mode === "stripe");
  $("mode-board").ariaPressed = String(state.mode === "board");
  $("laser").hidden = !state.can_switch_laser;
  $("laser").ariaPressed = String(state.laser === "on");
  write($("task"), [task.name, task.message].filter(Boolean).join(": "));
  showScan(state);
  showButtons();
  complain("camera", camera.error && `Camera: ${camera.error}`);
  complain("track", track.error && `Track: ${track.error}`);
  complain("scan", state.scan.state === "failed" && `Scan: ${state.scan.message}`);
}

// ---- talking to the server ------------------------------------------------------------------

const sleep = (ms) => new Promise((wake) => setTimeout(wake, ms));

class Refused extends Error {}

function showConnection(name, text) {
  $("connection").dataset.state = name;
  write($("connection"), text);
}

/** The answer to a request; Refused with the server's own words, TypeError without a server. */
async function ask(path, options = {}) {
  const answer = await fetch(path, { cache: "no-store", signal: AbortSignal.timeout(20000), ...options });
  if (answer.ok) return answer;
  const text = await answer.text();
  let line = text;
  try {
    line = JSON.parse(text).error ?? text;
  } catch {
    // a plain sentence
  }
  throw new Refused(line);
}

function connected() {
  showConnection("live", "live");
  complain("connection", "");
}

function disconnected(error) {
  const refused = error instanceof Refused;
  showConnection("lost", refused ? "refused" : "no connection");
  complain("connection", refused ? error.message : "No connection to lscan live; trying again.");
}

let queue = Promise.resolve(); // commands one after the other, each from the state the last left

function command(path, body = () => ({})) {
  queue = queue.then(async () => {
    try {
      const headers = { "Content-Type": "application/json" };
      const answer = await ask(path, { method: "POST", headers, body: JSON.stringify(body()) });
      complain("command", "");
      showState(await answer.json());
    } catch (error) {
      if (error instanceof Refused) complain("command", error.message);
      else disconnected(error);
    }
  });
}

async function watchState() {
  for (;;) {
    try {
      showState(await (await ask("/api/state")).json());
      connected();
    } catch (error) {
      disconnected(error);
    }
    await sleep(STATE_MS);
  }
}

/** The JSON and the picture of one answer: a length of 4 bytes, the JSON, the JPEG. */
function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0);
  const text = new TextDecoder().decode(new Uint8Array(buffer, 4, length));
  return [JSON.parse(text), new Blob([new Uint8Array(buffer, 4 + length)], { type: "image/jpeg" })];
}

const drawnAt = [];

function countFrame(f) {
  const now = performance.now();
  drawnAt.push(now);
  while (now - drawnAt[0] > RATE_WINDOW_MS) drawnAt.shift();
  const span = now - drawnAt[0];
  window.lscan.rateHz = span > 0 ? (1000 * (drawnAt.length - 1)) / span : 0;
  window.lscan.lastNumber = f.number;
  window.lscan.framesDrawn += 1;
  if (f.stripe?.found && f.profile) window.lscan.profilesDrawn += 1;
}

const visible = () =>
  new Promise((go) => {
    if (!document.hidden) return go();
    return document.addEventListener("visibilitychange", () => go(visible()), { once: true });
  });

let numbersAt = -Infinity;

function draw(bitmap, f) {
  frame = f;
  drawPicture(bitmap, f);
  if (f.mode === "stripe") drawProfile(f.profile);
  countFrame(f);
  const now = performance.now();
  if (now - numbersAt < READABLE_MS) return;
  numbersAt = now;
  showNumbers(f);
  if (f.mode === "board") showBoard(f.board);
}

async function watchFrames() {
  let after = 0;
  for (;;) {
    await visible();
    let received = false;
    try {
      const answer = await ask(`/api/frame?after=${after}`);
      if (answer.status === 204) continue;
      received = true;
      const [f, jpeg] = unpack(await answer.arrayBuffer());
      const bitmap = await createImageBitmap(jpeg);
      draw(bitmap, f);
      bitmap.close();
      after = f.number;
      complain("picture", "");
    } catch (error) {
      if (received) complain("picture", `The picture cannot be drawn: ${error.message}`);
      after = 0; // a server started anew counts anew
      await sleep(RETRY_MS);
    }
  }
}

// ---- buttons and keys -----------------------------------------------------------------------

const moveTo = (position) =>
  command("/api/move", () => ({ position_mm: Math.round(1000 * position()) / 1000 }));

function start() {
  const name = $("name").value.trim();
  command("/api/scan/start", () => (name ? { name } : {}));
  $("name").value = "";
}

function wireButtons() {
  const actions = {
    start,
    pause: () => command("/api/scan/pause"),
    resume: () => command("/api/scan/resume"),
    stop: () => command("/api/scan/stop"),
    "take-board": () => command("/api/board"),
    "mode-stripe": () => command("/api/mode", () => ({ mode: "stripe" })),
    "mode-board": () => command("/api/mode", () => ({ mode: "board" })),
    laser: () => command("/api/laser", () => ({ on: state.laser !== "on" })),
  };
  for (const [id, action] of Object.entries(actions)) $(id).addEventListener("click", action);
  for (const button of document.querySelectorAll(".jog"))
    button.addEventListener("click", () => moveTo(() => state.track.position_mm + Number(button.dataset.by)));
  $("go-to").addEventListener("submit", (event) => {
    event.preventDefault();
    const target = $("target").valueAsNumber;
    moveTo(() => target);
  });
  $("equal").addEventListener("change", () => frame?.mode === "stripe" && drawProfile(frame.profile));
}

/** The buttons that a key presses, the first that is enabled and not pressed already. */
const KEYS = {
  s: ["start"],
  p: ["pause", "resume"],
  m: ["mode-stripe", "mode-board"],
  b: ["take-board"],
  l: ["laser"],
  escape: ["stop"],
};

function pressKey(event) {
  const key = event.key.toLowerCase();
  const typing = event.target.matches("input:not([type=checkbox])") && key !== "escape";
  if (typing || event.repeat || event.ctrlKey || event.altKey || event.metaKey) return;
  const buttons = (KEYS[key] ?? []).map($);
  const chosen = buttons.find((one) => !one.disabled && !one.hidden && !(key === "m" && one.ariaPressed === "true"));
  if (!chosen) return;
  event.preventDefault();
  chosen.click();
}

readColours();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", readColours);
buildNumbers();
wireButtons();
document.addEventListener("keydown", pressKey);
for (const control of document.querySelectorAll("button, #name, #target")) control.disabled = true;
watchState();
watchFrames();
