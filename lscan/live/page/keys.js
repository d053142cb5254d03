// The keys that press buttons.

import { $ } from "./page.js";

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
  const usable = (one) => !one.disabled && !one.hidden;
  const changes = (one) => key !== "m" || one.ariaPressed !== "true";
  const chosen = (KEYS[key] ?? []).map($).find((one) => usable(one) && changes(one));
  if (!chosen) return;
  event.preventDefault();
  chosen.click();
}

/** Let the keys press their buttons, wherever on the page nothing is typed. */
export function wireKeys() {
  document.addEventListener("keydown", pressKey);
}
