const KEY = "accord.tab";

/**
 * The name of this tab, under which the server leases pairs to it. It survives a reload.
 *
 * It is in the browser's storage only while the page is closed: a browser copies the storage of an open tab when the
 * user duplicates it, and the copy needs a name of its own.
 */
export const TAB: string = takeName();

window.addEventListener("pagehide", () => {
  try {
    sessionStorage.setItem(KEY, TAB);
  } catch (error) {
    console.warn("Browser storage is unavailable: a reload may show another pair.", error);
  }
});

function takeName(): string {
  try {
    const kept = sessionStorage.getItem(KEY);
    sessionStorage.removeItem(KEY);
    if (kept) return kept;
  } catch (error) {
    console.warn("Browser storage is unavailable: a reload may show another pair.", error);
  }
  return Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) =>
    byte.toString(16).padStart(2, "0"),
  ).join("");
}
