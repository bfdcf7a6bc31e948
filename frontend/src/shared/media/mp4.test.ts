import { expect, test } from "vitest";
import { ClipUnplayable } from "./clip";
import { readMp4 } from "./mp4";

/** A box with its size and type. */
function box(type: string, ...content: (number[] | Uint8Array)[]): Uint8Array {
  const body = content.flatMap((each) => [...each]);
  return Uint8Array.from([...u32(8 + body.length), ...[...type].map((c) => c.charCodeAt(0)), ...body]);
}

const u32 = (value: number) => [value >>> 24, (value >>> 16) & 255, (value >>> 8) & 255, value & 255];

/** Three frames in two chunks, at the end of the file. The index has `extra` boxes. */
function clip(...extra: Uint8Array[]): Uint8Array {
  const frames = [[1], [2, 2], [3, 3, 3]];
  const data = box("mdat", frames.flat());
  const entry = box("avc1", new Array<number>(24).fill(0), [1, 64, 0, 240], new Array<number>(50).fill(0), [
    ...box("avcC", [1, 0x64, 0, 0x1f]),
  ]);
  const table = box(
    "stbl",
    box("stsd", u32(0), u32(1), entry),
    box("stsz", u32(0), u32(0), u32(3), ...[1, 2, 3].map(u32)),
    box("stsc", u32(0), u32(2), u32(1), u32(2), u32(1), u32(2), u32(1), u32(1)),
    box("stco", u32(0), u32(2), u32(8), u32(11)),
    box("stss", u32(0), u32(1), u32(1)),
    ...extra,
  );
  const index = box("moov", box("trak", box("mdia", box("minf", table))));
  return Uint8Array.from([...data, ...index]);
}

test("frames are found in their chunks", () => {
  const { config, width, height, samples } = readMp4(clip().buffer as ArrayBuffer);
  expect([config.codec, width, height]).toEqual(["avc1.64001f", 320, 240]);
  expect(samples.map(({ isKey, data }) => [isKey, [...data]])).toEqual([
    [true, [1]],
    [false, [2, 2]],
    [false, [3, 3, 3]],
  ]);
});

test("other files are refused, for the video element to play", () => {
  expect(() => readMp4(clip(box("ctts", u32(0))).buffer as ArrayBuffer)).toThrow(ClipUnplayable);
  expect(() =>
    readMp4(new TextEncoder().encode("no video, but long enough").buffer as ArrayBuffer),
  ).toThrow();
  expect(() => readMp4(clip().slice(0, 200).buffer as ArrayBuffer)).toThrow();
});
