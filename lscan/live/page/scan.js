// The scan: how far it is, and which buttons the server would accept now.

import { $, clock, write } from "./page.js";

const STATES = {
  idle: "ready",
  scanning: "scanning",
  paused: "paused",
  stopping: "stopping after this frame",
  done: "done",
  failed: "failed",
};

const moving = ({ scan }) => ["scanning", "stopping"].includes(scan.state);

/** The state in words; one left idle with a folder was stopped. */
const inWords = ({ state, folder }) =>
  state === "idle" && folder !== null ? "stopped" : STATES[state];

function resumable({ scan }) {
  const unfinished = scan.folder !== null && scan.done < scan.planned;
  const ended = ["idle", "done"].includes(scan.state);
  return ["paused", "failed"].includes(scan.state) || (ended && unfinished);
}

/** Disable all that asks something of the server. */
export function disableButtons() {
  for (const control of document.querySelectorAll("button, #name, #target")) control.disabled = true;
}

/** Enable exactly what the server would accept now, and devices could carry out. */
export function showButtons(state) {
  const scan = state.scan.state;
  const free = !moving(state) && !state.task.name;
  const seeing = free && !state.camera.gone;
  const allowed = {
    start: seeing && scan !== "paused",
    name: free && scan !== "paused",
    pause: scan === "scanning",
    resume: seeing && resumable(state),
    stop: scan === "scanning" || scan === "paused",
    "mode-stripe": true,
    "mode-board": state.board,
    "take-board": state.board && seeing && scan !== "paused",
    laser: free,
    target: free,
    go: free,
  };
  const active = document.activeElement;
  for (const [id, may] of Object.entries(allowed)) $(id).disabled = !may;
  for (const button of document.querySelectorAll(".jog"))
    button.disabled = !free || state.track.position_mm === null;
  // A button that goes dead under the finger hands the focus to its neighbour; what is looked at
  // stays in view.
  if (active?.disabled)
    active.closest(".buttons")?.querySelector("button:enabled")?.focus({ preventScroll: true });
}

/** Show how far the scan is, or what it would be, and where its folder is. */
export function showScan({ scan, plan }) {
  document.body.dataset.scan = scan.state;
  const stopping = scan.state === "stopping";
  write($("scan-state"), (stopping && scan.message) || inWords(scan));
  const running = scan.state !== "idle" || scan.folder !== null;
  $("progress").value = running && scan.planned ? scan.done / scan.planned : 0;
  const parts = running
    ? [
        `${scan.done} of ${scan.planned} frames`,
        scan.left_s === null ? "" : `${clock(scan.left_s)} left`,
        scan.elapsed_s ? `${clock(scan.elapsed_s)} gone` : "",
        scan.folder?.split("/").slice(-2).join("/"),
        scan.state === "failed" || stopping ? "" : scan.message,
      ]
    : [`${plan.frames} frames from ${plan.start_mm} mm, every ${plan.step_mm} mm`];
  $("scan-note").title = scan.folder ?? "";
  write($("scan-note"), parts.filter(Boolean).join(" · "));
  const percent = Math.round(100 * $("progress").value);
  document.title = moving({ scan }) ? `${percent} % · lscan live` : "lscan live";
}
