// The loop of pictures: asks for the next, draws it with what was measured in it, and counts it.

import { complain } from "./alerts.js";
import { showBoard } from "./board.js";
import { measured } from "./measured.js";
import { $ } from "./page.js";
import { drawPicture } from "./picture.js";
import { drawProfile } from "./profile.js";
import { ask, sleep } from "./server.js";
import { showTiles } from "./tiles.js";

const RETRY_MS = 1000;
const READABLE_MS = 200; // figures that change faster than this cannot be read
const RATE_WINDOW_MS = 2000;

let shown = null; // the frame last drawn
let figuresAt = -Infinity; // ms, when its figures were last written
const drawnAt = []; // ms, when each picture of the rate's window was drawn

/** The JSON and the picture of one answer: a length of 4 bytes, the JSON, the JPEG. */
function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0);
  const text = new TextDecoder().decode(new Uint8Array(buffer, 4, length));
  return [JSON.parse(text), new Blob([new Uint8Array(buffer, 4 + length)], { type: "image/jpeg" })];
}

function countFrame(f) {
  const now = performance.now();
  drawnAt.push(now);
  while (now - drawnAt[0] > RATE_WINDOW_MS) drawnAt.shift();
  const span = now - drawnAt[0];
  measured.rateHz = span > 0 ? (1000 * (drawnAt.length - 1)) / span : 0;
  measured.lastNumber = f.number;
  measured.framesDrawn += 1;
  if (f.stripe?.found && f.profile) measured.profilesDrawn += 1;
}

/** Wait until the page is in view. */
const visible = () =>
  new Promise((go) => {
    if (!document.hidden) return go();
    return document.addEventListener("visibilitychange", () => go(visible()), { once: true });
  });

function draw(bitmap, f) {
  shown = f;
  drawPicture(bitmap, f);
  if (f.mode === "stripe") drawProfile(f.profile);
  countFrame(f);
  const now = performance.now();
  if (now - figuresAt < READABLE_MS) return;
  figuresAt = now;
  showTiles(f);
  if (f.mode === "board") showBoard(f);
}

/** Ask for the next picture when the last is drawn, for as long as the page is in view. */
export async function watchFrames() {
  let after = 0;
  for (;;) {
    await visible();
    let received = false;
    try {
      const answer = await ask(`/api/frame?after=${after}`);
      if (answer.status === 204) continue;
      received = true;
      const [f, jpeg] = unpack(await answer.arrayBuffer());
      const bitmap = await createImageBitmap(jpeg);
      draw(bitmap, f);
      bitmap.close();
      after = f.number;
      complain("picture", "");
    } catch (error) {
      if (received) complain("picture", `The picture cannot be drawn: ${error.message}`);
      after = 0; // a server started anew counts anew
      await sleep(RETRY_MS);
    }
  }
}

/** Draw the profile anew when its scales or its size change, also where no more pictures come. */
export function followScales() {
  const redraw = () => shown?.mode === "stripe" && drawProfile(shown.profile);
  $("equal").addEventListener("change", redraw);
  window.addEventListener("resize", redraw);
}
