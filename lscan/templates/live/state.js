// The state of camera, track and scan, asked for twice a second and answered by each command.

import { complain, connected, disconnected } from "./alerts.js";
import { $, write } from "./page.js";
import { showButtons, showScan } from "./scan.js";
import { Refused, ask, sleep } from "./server.js";

const PERIOD_MS = 500;
const REOPENS = " – Go, Start and Resume open it again by themselves.";

let state = null;
let queue = Promise.resolve(); // commands one after the other, each from the state the last left

/** What the server last said; null before its first answer. */
export const known = () => state;

function showState(answer) {
  state = answer;
  const { camera, track, task } = state;
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
  complain("camera", camera.error && `Camera: ${camera.error}`);
  complain("track", track.error && `Track: ${track.error}${REOPENS}`);
  complain("scan", state.scan.state === "failed" && `Scan: ${state.scan.message}`);
}

/** Send a command, its body made when its turn comes, and show the state that it leaves. */
export function command(path, body = () => ({})) {
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

/** Ask for the state again and again, whether or not there is a server. */
export async function watchState() {
  for (;;) {
    try {
      showState(await (await ask("/api/state")).json());
      connected();
    } catch (error) {
      disconnected(error);
    }
    await sleep(PERIOD_MS);
  }
}
