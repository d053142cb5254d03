// What a click on each button asks of the server.

import { $ } from "./page.js";
import { disableButtons } from "./scan.js";
import { command, known } from "./state.js";

const moveTo = (position) =>
  command("/api/move", () => ({ position_mm: Math.round(1000 * position()) / 1000 }));

function start() {
  const name = $("name").value.trim();
  command("/api/scan/start", () => (name ? { name } : {}));
  $("name").value = "";
}

/** Let the buttons act; they are dead until the server has said what can be done. */
export function wireButtons() {
  const actions = {
    start,
    pause: () => command("/api/scan/pause"),
    resume: () => command("/api/scan/resume"),
    stop: () => command("/api/scan/stop"),
    "take-board": () => command("/api/board"),
    "mode-stripe": () => command("/api/mode", () => ({ mode: "stripe" })),
    "mode-board": () => command("/api/mode", () => ({ mode: "board" })),
    laser: () => command("/api/laser", () => ({ on: known().laser !== "on" })),
  };
  for (const [id, action] of Object.entries(actions)) $(id).addEventListener("click", action);
  for (const button of document.querySelectorAll(".jog"))
    button.addEventListener("click", () => {
      const by = Number(button.dataset.by);
      moveTo(() => known().track.position_mm + by);
    });
  $("go-to").addEventListener("submit", (event) => {
    event.preventDefault();
    const target = $("target").valueAsNumber;
    moveTo(() => target);
  });
  disableButtons();
}
