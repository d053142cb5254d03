// Which advice holds when: the only place that decides it.
//
// A calibration and a scan are those of the optics and the exposure that they began with: what
// would spoil them is not advised.  A frame's phase is "alignment", "calibrated" or "scan".

const HOLDS = {
  optics: ["alignment"], // lens, aperture, laser
  calibration: ["alignment"],
  exposure: ["alignment", "calibrated"],
  board: ["alignment", "calibrated"], // its place
};

/** Whether advice of that kind holds in the frame's phase. */
export const holds = (f, kind) => HOLDS[kind].includes(f.phase);

/** The fault, followed by what to do about it where that holds in the frame's phase. */
export const advise = (f, kind, fault, todo) =>
  holds(f, kind) ? `${fault}: ${todo}` : fault;
