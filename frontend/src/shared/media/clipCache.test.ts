import { afterEach, beforeEach, describe, expect, test, vi } from "vitest";
import { type Clip, type ClipSource, ClipUnreachable } from "./clip";
import { ClipCache } from "./clipCache";

const source = (url: string): ClipSource => ({ url, frames: 2, seconds: 0.1 });

let closed: string[];
let fetched: string[];
let failures: number;

const decode = async (blob: Blob): Promise<Clip> => {
  const url = await blob.text();
  const frame = { close: () => closed.push(url) } as unknown as ImageBitmap;
  return { frames: [frame], frameSeconds: 0.05, width: 10, height: 10 };
};

beforeEach(() => {
  vi.useFakeTimers();
  closed = [];
  fetched = [];
  failures = 0;
  vi.stubGlobal("fetch", async (url: string) => {
    fetched.push(url);
    if (failures > 0) {
      failures -= 1;
      throw new TypeError("Failed to fetch");
    }
    return url === "/missing" ? new Response("", { status: 404 }) : new Response(url);
  });
});
afterEach(() => {
  vi.useRealTimers();
  vi.unstubAllGlobals();
});

describe("ClipCache", () => {
  test("a prefetched clip is downloaded once", async () => {
    const clips = new ClipCache(decode);
    clips.prefetch([source("/a"), source("/b")]);
    clips.prefetch([source("/b"), source("/c")]);
    await clips.load(source("/b"));
    await clips.load(source("/c"));
    expect(fetched).toEqual(["/a", "/b", "/c"]);
  });

  test("a pair is downloaded after the one before it, and a pair that is on screen at once", async () => {
    const arrivals = new Map<string, () => void>();
    vi.stubGlobal("fetch", (url: string) => {
      fetched.push(url);
      return new Promise((resolve) => arrivals.set(url, () => resolve(new Response(url))));
    });
    const settle = () => vi.advanceTimersByTimeAsync(1);
    const clips = new ClipCache(decode);
    clips.prefetch(["/a", "/b", "/c", "/d", "/e", "/f"].map(source));
    await settle();
    expect(fetched).toEqual(["/a", "/b"]);
    arrivals.get("/a")?.();
    await settle();
    expect(fetched).toEqual(["/a", "/b", "/c"]);
    const shown = clips.load(source("/f"));
    await settle();
    expect(fetched.at(-1)).toBe("/f");
    arrivals.get("/f")?.();
    expect((await shown).width).toBe(10);
    clips.prefetch([source("/e")]);
    for (const url of ["/b", "/c"]) arrivals.get(url)?.();
    await settle();
    expect(fetched).toEqual(["/a", "/b", "/c", "/f", "/e"]);
  });

  test("a decoded clip is ready until it is freed", async () => {
    const clips = new ClipCache(decode);
    expect(clips.ready(source("/a"))).toBeUndefined();
    clips.prefetch([source("/a")]);
    const loaded = await clips.load(source("/a"));
    expect(clips.ready(source("/a"))).toBe(loaded);
    clips.clear();
    expect(clips.ready(source("/a"))).toBeUndefined();
  });

  test("frames of clips that are no longer prefetched are freed, even if they were still being decoded", async () => {
    const clips = new ClipCache(decode);
    clips.prefetch([source("/a"), source("/b")]);
    await clips.load(source("/a"));
    clips.prefetch([source("/b")]);
    clips.clear();
    await vi.advanceTimersByTimeAsync(10);
    expect(closed.sort()).toEqual(["/a", "/b"]);
  });

  test("a lost connection is retried", async () => {
    failures = 2;
    const clips = new ClipCache(decode);
    const loading = clips.load(source("/a"));
    await vi.advanceTimersByTimeAsync(5_000);
    expect((await loading).width).toBe(10);
    expect(fetched).toHaveLength(3);
  });

  test("an unreachable server and a missing clip raise different errors, and the next call retries", async () => {
    failures = 4;
    const clips = new ClipCache(decode);
    const loading = expect(clips.load(source("/a"))).rejects.toBeInstanceOf(ClipUnreachable);
    await vi.advanceTimersByTimeAsync(5_000);
    await loading;
    await expect(clips.load(source("/missing"))).rejects.not.toBeInstanceOf(ClipUnreachable);
    expect((await clips.load(source("/a"))).width).toBe(10);
  });

  test("a missing clip fails without a retry, and the next call requests it again", async () => {
    const clips = new ClipCache(decode);
    await expect(clips.load(source("/missing"))).rejects.toThrow("404");
    await expect(clips.load(source("/missing"))).rejects.toThrow("404");
    expect(fetched).toEqual(["/missing", "/missing"]);
  });
});
