// Connections: a browser has six to a server, for all of its windows together. A stream holds one for as long as it is
// open; so of each kind of stream some may be open, and one connection at least is left for calls.

/** Streams that may be open at a time. */
const PLACES = { watch: 3, hold: 2 };

/** Takes a place for a stream, if one is left; the result gives it back. Closing the window does so, too. */
export async function place(kind: keyof typeof PLACES): Promise<(() => void) | undefined> {
  // Locks are known to pages over HTTPS and of this machine; others know nothing of other windows.
  if (!("locks" in navigator)) return () => undefined;
  for (let number = 0; number < PLACES[kind]; number++) {
    const giveBack = await take(`plantd.${kind}.${number}`);
    if (giveBack) return giveBack;
  }
  return undefined;
}

function take(name: string): Promise<(() => void) | undefined> {
  return new Promise((resolve, reject) => {
    const held = (lock: Lock | null): Promise<void> | undefined => {
      if (lock) return new Promise((giveBack) => resolve(giveBack));
      resolve(undefined);
      return undefined;
    };
    navigator.locks.request(name, { ifAvailable: true }, held).catch(reject);
  });
}
