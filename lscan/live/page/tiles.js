// The figures on the page: a tile with its verdict for each, and the legend of the verdicts.

import { FIGURES } from "./figures.js";
import { $, element, fixed, write } from "./page.js";

const TILES = new Map(); // of each figure
const judged = new Map(); // what each figure was last said to be

/** One tile and one line of the legend for each figure. */
export function buildTiles() {
  for (const figure of FIGURES) {
    const tile = element("div", figure.mode ? `tile ${figure.mode}-only` : "tile");
    const value = element("dd", "value");
    const unit = figure.unit ? ` ${figure.unit}` : "";
    value.append(element("span", "number"), element("small", "", unit));
    tile.append(element("dt", "", figure.title), value);
    if (figure.meter) {
      const meter = Object.assign(element("meter", ""), { max: 1, ariaLabel: figure.title });
      const bar = element("dd", "");
      bar.append(meter);
      tile.append(bar);
    }
    tile.append(element("dd", "verdict"));
    tile.dataset.number = figure.name;
    tile.title = figure.legend;
    $("tiles").append(tile);
    const shown = figure.mode ? `${figure.mode}-only` : "";
    $("legend").append(element("dt", shown, figure.title), element("dd", shown, figure.legend));
    TILES.set(figure, tile);
  }
}

/** Show the figures of a frame. */
export function showTiles(f) {
  for (const [figure, tile] of TILES) {
    const { show, judge, meter } = figure;
    judged.set(figure, judge(f, judged.get(figure)));
    const [grade, verdict] = judged.get(figure);
    tile.dataset.grade = grade;
    write(tile.querySelector(".number"), show(f));
    write(tile.querySelector(".verdict"), verdict);
    if (meter) tile.querySelector("meter").value = meter(f);
  }
  write($("position"), f.position_mm === null ? "" : `at ${fixed(f.position_mm, 2)} mm`);
  write($("caption"), `${f.size_px.join(" × ")} · picture ${f.number}`);
}
