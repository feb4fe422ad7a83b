// Who the person at the page is: a token, kept for this tab alone, and sent in a header with every request to the server.

import { byId, fill, h } from "./dom.js";

const KEY = "plantd.token";

/** `#token=...`: a fragment is sent to nobody. It does not stay in the address, where others would see it. */
function fromAddress(): void {
  const fragment = new URLSearchParams(location.hash.slice(1));
  const token = fragment.get("token");
  if (token === null) return;
  keep(token);
  fragment.delete("token");
  const rest = fragment.toString();
  history.replaceState(history.state, "", location.pathname + location.search + (rest === "" ? "" : `#${rest}`));
}

function keep(token: string): void {
  try {
    sessionStorage.setItem(KEY, token.trim());
  } catch {
    present = token.trim();
  }
}

/** Where the browser stores nothing. */
let present = "";

/** The token that is in use; empty where there is none. */
export function known(): string {
  try {
    return sessionStorage.getItem(KEY) ?? present;
  } catch {
    return present;
  }
}

const plain = globalThis.fetch.bind(globalThis);

/** `fetch`, with the token where the server of the page is asked. */
globalThis.fetch = (input, init) => {
  const request = new Request(input, init);
  const token = known();
  if (token !== "" && new URL(request.url).origin === location.origin) request.headers.set("authorization", `Bearer ${token}`);
  return plain(request);
};

fromAddress();

let asking: Promise<void> | undefined;

/** Asks for a token, once for all who need it; `why` is what the server has said. */
export function askForToken(why: string): Promise<void> {
  asking ??= new Promise<void>((resolve) => {
    const dialog = byId<HTMLDialogElement>("token");
    const input = h("input", { type: "password", autocomplete: "off", spellcheck: "false", "aria-label": "Token" });
    const button = h("button", { type: "button" }, "Go on");
    const done = (): void => {
      if (input.value.trim() === "") return;
      keep(input.value);
      dialog.close();
    };
    button.addEventListener("click", done);
    input.addEventListener("keydown", (event) => {
      event.stopPropagation();
      if (event.key !== "Enter") return;
      // The key is used up: what has the focus when the dialog is closed is not pressed by it.
      event.preventDefault();
      done();
    });
    dialog.addEventListener("close", () => {
      asking = undefined;
      resolve();
    }, { once: true });
    fill(dialog, h("h2", { id: "token-title" }, "Who are you?"), h("p", {}, why), h("p", {}, input), button);
    dialog.showModal();
    input.focus();
  });
  return asking;
}
