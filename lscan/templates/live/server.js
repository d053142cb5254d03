// Requests to the server that served the page.

const LONGEST_MS = 20000; // longer than the server ever holds back an answer

export const sleep = (ms) => new Promise((wake) => setTimeout(wake, ms));

/** The server said no, in words that are for whoever reads the page. */
export class Refused extends Error {}

/** The answer to a request; Refused with the server's own words, TypeError without a server. */
export async function ask(path, options = {}) {
  const signal = AbortSignal.timeout(LONGEST_MS);
  const answer = await fetch(path, { cache: "no-store", signal, ...options });
  if (answer.ok) return answer;
  const text = await answer.text();
  let line = text;
  try {
    line = JSON.parse(text).error ?? text;
  } catch {
    // a plain sentence
  }
  throw new Refused(line);
}
