import { readFileSync } from "node:fs";
import { describe, expect, test } from "vitest";
import { Mp4Unreadable, readMp4 } from "./mp4";

// Twelve grey frames of 64x48 at 20 Hz, written by PyAV's libx264 with B-frames.
const bytes = new Uint8Array(readFileSync(new URL("fixtures/twelve-frames.mp4", import.meta.url)));

describe("readMp4", () => {
  test("finds the codec, the size and every frame's time", () => {
    const track = readMp4(bytes);
    expect(track.codec).toMatch(/^avc1\.[0-9a-f]{6}$/);
    expect([track.width, track.height]).toEqual([64, 48]);
    const shown = track.samples.map(({ seconds }) => seconds).sort((a, b) => a - b);
    expect(shown).toHaveLength(12);
    shown.forEach((seconds, index) => {
      expect(seconds).toBeCloseTo(index * 0.05, 9);
    });
    expect(track.samples[0]?.key).toBe(true);
  });

  test("every sample is a whole number of H.264 units", () => {
    const view = new DataView(bytes.buffer, bytes.byteOffset);
    for (const { offset, size } of readMp4(bytes).samples) {
      let at = offset;
      while (at < offset + size) at += 4 + view.getUint32(at);
      expect(at).toBe(offset + size);
    }
  });

  test.each([
    ["an empty file", bytes.slice(0, 0)],
    ["half a file", bytes.slice(0, bytes.length - 200)],
    ["a text", new TextEncoder().encode("this is not a video at all, but a sentence")],
  ])("%s is refused by name", (_, broken) => {
    expect(() => readMp4(broken)).toThrow(Mp4Unreadable);
  });
});
