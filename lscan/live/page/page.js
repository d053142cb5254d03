// The page's elements, and numbers as they are written in it.

export const $ = (id) => document.getElementById(id);

/** Write text only where it changed: an unchanged live region must not be read out again. */
export function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function element(tag, className, text = "") {
  const made = document.createElement(tag);
  made.className = className;
  made.textContent = text;
  return made;
}

/** A number with so many decimals and a true minus sign; a dash where there is none. */
export const fixed = (value, digits) =>
  value === null || value === undefined ? "–" : value.toFixed(digits).replace("-", "−");

export const signed = (value, digits) =>
  (Number(value.toFixed(digits)) > 0 ? "+" : "") + fixed(value, digits);

/** Seconds as minutes:seconds. */
export const clock = (seconds) =>
  `${Math.floor(seconds / 60)}:${String(Math.floor(seconds % 60)).padStart(2, "0")}`;
