// The state of camera, track and scan, asked for twice a second and answered by each command.

import { complain, connected, disconnected } from "./alerts.js";
import { $, write } from "./page.js";
import { disableButtons, showButtons, showScan } from "./scan.js";
import { Refused, ask, sleep } from "./server.js";

const PERIOD_MS = 500;
const REFUSED_MS = 10000; // for so long it is said why a command was refused
const ANSWER_MS = 5000; // a server that takes longer to answer counts as lost
const MAY_BE_LIT = "Laser: it may still be lit: switch it off at its supply.";
const REOPENS = " – Go, Start and Resume open it again by themselves.";

let state = null;
let seenAt = null; // Date when the camera gave its last picture
let queue = Promise.resolve(); // commands one after the other, each from the state the last left
let refusedAt = 0; // when the last command was refused, ms
let obeyed = 0; // commands answered so far

/** What the server last said; null before its first answer. */
export const known = () => state;

/** Show whether the picture is of now, and if not, of when it is. */
function showLive(live) {
  document.body.dataset.live = String(live);
  const today = seenAt?.toDateString() === new Date().toDateString();
  const format = { dateStyle: today ? undefined : "short", timeStyle: "medium", hourCycle: "h23" };
  const when = seenAt ? `last picture at ${seenAt.toLocaleString([], format)}` : "no picture yet";
  write($("since"), live ? "" : when);
}

/** No answer: nothing can be asked for, the picture is an old one, and the laser as it was. */
function lost(error) {
  disconnected(error);
  if (state?.laser === "on") complain("laser", MAY_BE_LIT);
  disableButtons();
  showLive(false);
}

function showState(answer) {
  state = answer;
  const { camera, track, task } = state;
  seenAt = camera.seen_s_ago === null ? null : new Date(Date.now() - 1000 * camera.seen_s_ago);
  connected(!camera.gone);
  showLive(!camera.gone);
  write($("rig"), state.rig);
  const calibration = state.calibration ? state.calibration.split("/").pop() : "no calibration";
  const devices = [`camera ${camera.driver}`, `track ${track.driver}`, calibration];
  write($("devices"), devices.join(" · "));
  document.body.dataset.mode = state.mode;
  $("mode-stripe").ariaPressed = String(state.mode === "stripe");
  $("mode-board").ariaPressed = String(state.mode === "board");
  $("laser").hidden = !state.can_switch_laser;
  $("laser").ariaPressed = String(state.laser === "on");
  write($("task"), [task.name, task.message].filter(Boolean).join(": "));
  showScan(state);
  showButtons(state);
  if (Date.now() > refusedAt + REFUSED_MS) complain("command", "");
  complain("laser", state.laser_warning && MAY_BE_LIT);
  complain("camera", camera.error && `Camera: ${camera.error}`);
  complain("track", track.error && `Track: ${track.error}${REOPENS}`);
  const { scan } = state;
  complain("scan", scan.state === "failed" && `Scan: ${scan.message}`, scan.by_device);
}

/** Send a command, its body made when its turn comes, and show the state that it leaves. */
export function command(path, body = () => ({})) {
  queue = queue.then(async () => {
    try {
      const headers = { "Content-Type": "application/json" };
      const answer = await ask(path, { method: "POST", headers, body: JSON.stringify(body()) });
      complain("command", "");
      showState(await answer.json());
      obeyed += 1;
    } catch (error) {
      if (error instanceof Refused) {
        complain("command", error.message, error.byDevice);
        refusedAt = Date.now();
      } else lost(error);
    }
  });
}

/** Ask for the state again and again, whether or not there is a server. */
export async function watchState() {
  for (;;) {
    const before = obeyed;
    try {
      const signal = AbortSignal.timeout(ANSWER_MS);
      const answer = await (await ask("/api/state", { signal })).json();
      if (obeyed === before) showState(answer); // else it may be from before the command
    } catch (error) {
      lost(error);
    }
    await sleep(PERIOD_MS);
  }
}
