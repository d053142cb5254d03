// What is wrong, and whether there is a server at all.

import { $, write } from "./page.js";
import { Refused } from "./server.js";

const faults = {}; // of each origin [text, whether camera or track is at fault]
const textOf = (origin) => faults[origin]?.[0] ?? "";

/**
 * Show the fault of one origin in the alert line, or clear it with "".
 *
 * Each fault is shown once: a consequence of a fault of camera or track is not shown beside that
 * fault, and without a server its absence alone is shown, and that the laser may be lit.
 */
export function complain(origin, text, byDevice = false) {
  faults[origin] = [text || "", byDevice];
  const device = textOf("camera") || textOf("track");
  if (device && faults.command?.[1]) delete faults.command;
  const { connection, laser } = faults;
  const shown = connection?.[0]
    ? [laser ?? [], connection]
    : Object.values(faults).filter(([, byDevice]) => !(device && byDevice));
  write($("alert"), shown.map(([text]) => text).filter(Boolean).join("\n"));
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
