// The live page: draws each picture with what was measured in it, and sends the buttons' commands.
//
// Two loops talk to the server.  One asks for the next picture when the last is drawn, so that
// a slow browser delays itself alone; the other asks for the state of camera, track
// and scan.  Everything shown comes from these two answers.

import { wireButtons } from "./buttons.js";
import { followColours } from "./colours.js";
import { followScales, watchFrames } from "./frames.js";
import { wireKeys } from "./keys.js";
import { followClicks } from "./picture.js";
import { watchState } from "./state.js";
import { buildTiles } from "./tiles.js";

followColours();
followScales();
followClicks();
buildTiles();
wireButtons();
wireKeys();
watchState();
watchFrames();
