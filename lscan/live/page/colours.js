// The colours that are drawn with, as the style sheet gives them for light and dark.

export const COLOURS = {};

function readColours() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["stripe", "clipped", "mark", "ink", "muted", "rule", "accent"])
    COLOURS[name] = style.getPropertyValue(`--${name}`).trim();
}

/** Read them now, and again whenever the browser turns from light to dark or back. */
export function followColours() {
  readColours();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", readColours);
}
