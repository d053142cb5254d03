// What is wrong, and whether there is a server at all.

import { $, write } from "./page.js";
import { Refused } from "./server.js";

const faults = {};

/** Show a fault of one origin in the alert line, or take it away with "". */
export function complain(origin, text) {
  faults[origin] = text || "";
  write($("alert"), Object.values(faults).filter(Boolean).join("\n"));
}

function showConnection(name, text) {
  $("connection").dataset.state = name;
  write($("connection"), text);
}

/** The server has answered. */
export function connected() {
  showConnection("live", "live");
  complain("connection", "");
}

/** The server has refused, or has not answered. */
export function disconnected(error) {
  const refused = error instanceof Refused;
  showConnection("lost", refused ? "refused" : "no connection");
  complain("connection", refused ? error.message : "No connection to lscan live; trying again.");
}
