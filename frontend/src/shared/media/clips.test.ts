import { afterEach, beforeEach, describe, expect, test, vi } from "vitest";
import { type Clip, type ClipSource, ClipUnreachable } from "./clip";
import { Clips } from "./clips";

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

describe("Clips", () => {
  test("what is wanted is loaded once, ahead of being shown", async () => {
    const clips = new Clips(decode);
    clips.want([source("/a"), source("/b")]);
    clips.want([source("/b"), source("/c")]);
    await clips.load(source("/b"));
    expect(fetched).toEqual(["/a", "/b", "/c"]);
  });

  test("pictures that nobody wants any more are freed, even those that were still being made", async () => {
    const clips = new Clips(decode);
    clips.want([source("/a"), source("/b")]);
    await clips.load(source("/a"));
    clips.want([source("/b")]);
    clips.clear();
    await vi.advanceTimersByTimeAsync(10);
    expect(closed.sort()).toEqual(["/a", "/b"]);
  });

  test("a lost connection is tried again", async () => {
    failures = 2;
    const clips = new Clips(decode);
    const loading = clips.load(source("/a"));
    await vi.advanceTimersByTimeAsync(5_000);
    expect((await loading).width).toBe(10);
    expect(fetched).toHaveLength(3);
  });

  test("a server that stays away is told apart from a clip that is not there, and asked again", async () => {
    failures = 4;
    const clips = new Clips(decode);
    const loading = expect(clips.load(source("/a"))).rejects.toBeInstanceOf(ClipUnreachable);
    await vi.advanceTimersByTimeAsync(5_000);
    await loading;
    await expect(clips.load(source("/missing"))).rejects.not.toBeInstanceOf(ClipUnreachable);
    expect((await clips.load(source("/a"))).width).toBe(10);
  });

  test("a clip that is not there fails at once, and is asked for again by the next call", async () => {
    const clips = new Clips(decode);
    await expect(clips.load(source("/missing"))).rejects.toThrow("404");
    await expect(clips.load(source("/missing"))).rejects.toThrow("404");
    expect(fetched).toEqual(["/missing", "/missing"]);
  });
});
