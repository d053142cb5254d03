// Requests to the server that served the page.

const LONGEST_MS = 20000; // longer than the server ever holds back an answer

export const sleep = (ms) => new Promise((wake) => setTimeout(wake, ms));

/** The server refused a request, with a message for the user; byDevice: a device is at fault. */
export class Refused extends Error {
  constructor(message, byDevice) {
    super(message);
    this.byDevice = byDevice;
  }
}

/** The answer to a request; Refused with the server's own words, TypeError without a server. */
export async function ask(path, options = {}) {
  const signal = AbortSignal.timeout(LONGEST_MS);
  const answer = await fetch(path, { cache: "no-store", signal, ...options });
  if (answer.ok) return answer;
  const text = await answer.text();
  let refusal = { error: text };
  try {
    refusal = JSON.parse(text);
  } catch {
    // a plain sentence
  }
  throw new Refused(refusal.error ?? text, refusal.device ?? false);
}
