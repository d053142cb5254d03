// What is wrong, and whether there is a server at all.

import { $, write } from "./page.js";
import { Refused } from "./server.js";

const faults = {}; // of each origin [text, whether camera or track is to blame]
const textOf = (origin) => faults[origin]?.[0] ?? "";

/**
 * Show a fault of one origin in the alert line, or take it away with "".
 *
 * Each is told once: what came of a fault of camera or track, not beside that fault itself; and
 * without a server nothing but this is known.
 */
export function complain(origin, text, byDevice = false) {
  faults[origin] = [text || "", byDevice];
  const device = textOf("camera") || textOf("track");
  if (device && faults.command?.[1]) delete faults.command;
  const told = Object.values(faults).filter(([, blamed]) => !(device && blamed));
  write($("alert"), textOf("connection") || told.map(([one]) => one).filter(Boolean).join("\n"));
}

function showConnection(name, text) {
  $("connection").dataset.state = name;
  write($("connection"), text);
}

/** The server has answered: its pictures are of now, or of a camera that is gone. */
export function connected(live) {
  showConnection(live ? "live" : "lost", live ? "live" : "not live");
  complain("connection", "");
}

/** The server has refused, or has not answered. */
export function disconnected(error) {
  const refused = error instanceof Refused;
  showConnection("lost", "not live");
  complain("connection", refused ? error.message : "No connection to lscan live; trying again.");
}
