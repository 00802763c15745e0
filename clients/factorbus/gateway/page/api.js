// The gateway's answers, and edits: as JSON, with the header that only a page of the gateway's own can send.

const KEPT = "factorbus token";

export class Refusal extends Error {
  constructor({ code, message }) {
    super(message);
    this.code = code;
  }
}

export const mapPath = (name) => `/api/maps/${encodeURIComponent(name)}`;

export const signedIn = () => sessionStorage.getItem(KEPT) !== null;

export function sign(token) {
  if (token) sessionStorage.setItem(KEPT, token);
  else sessionStorage.removeItem(KEPT);
}

const who = () => (signedIn() ? { Authorization: `Bearer ${sessionStorage.getItem(KEPT)}` } : {});

export async function ask(path) {
  return read(await fetch(path, { headers: who() }));
}

export async function send(name, edit, token) {
  const headers = { ...who(), "Content-Type": "application/json", "X-Factorbus-Token": token };
  return read(await fetch(`${mapPath(name)}/edits`, { method: "POST", headers, body: JSON.stringify(edit) }));
}

async function read(answer) {
  const content = await answer.json();
  if (!answer.ok) throw new Refusal(content.problem);
  return content;
}
