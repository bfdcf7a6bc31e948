import { ClipUnplayable } from "./clip";

/** The encoded frames of a clip. */
export interface EncodedVideo {
  config: VideoDecoderConfig;
  width: number;
  height: number;
  /** in presentation order */
  samples: { isKey: boolean; data: Uint8Array<ArrayBuffer> }[];
}

type View = DataView<ArrayBuffer>;

/** Sizes of fixed parts, in bytes: of a box with version and flags, and of a video sample entry up to its boxes. */
const FULL_BOX = 4;
const VIDEO_SAMPLE_ENTRY = 78;

/**
 * Reads the H.264 track of an mp4 file as Accord's render workers write it: one track, not fragmented, no B-frames.
 *
 * A library for any mp4 file is 48 KB, a third of the labelling page. Whatever else a file contains, the caller plays it
 * with a video element.
 *
 * @throws ClipUnplayable for any other file, RangeError for a truncated one
 */
export function readMp4(file: ArrayBuffer): EncodedVideo {
  const whole = new DataView(file);
  const table = ["moov", "trak", "mdia", "minf", "stbl"].reduce((parent, type) => box(parent, type), whole);
  if (boxes(table).has("ctts")) throw new ClipUnplayable("The video has B-frames.");
  const entry = box(part(box(table, "stsd"), FULL_BOX + 4), "avc1");
  const description = bytes(box(part(entry, VIDEO_SAMPLE_ENTRY), "avcC"));
  const profile = [...description.subarray(1, 4)].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  const [width, height] = [entry.getUint16(24), entry.getUint16(26)];
  return {
    config: { codec: `avc1.${profile}`, description, codedWidth: width, codedHeight: height },
    width,
    height,
    samples: samplesOf(table, whole),
  };
}

function samplesOf(table: View, file: View): EncodedVideo["samples"] {
  const sizes = sizesOf(box(table, "stsz"));
  const offsets = offsetsOf(table);
  const keys = boxes(table).get("stss");
  const keyNumbers = keys && new Set(numbers(part(keys, FULL_BOX + 4), keys.getUint32(FULL_BOX)));
  const runs = box(table, "stsc");
  const samples: EncodedVideo["samples"] = [];
  let run = -1;
  offsets.forEach((chunkOffset, chunk) => {
    // A run of chunks with equally many samples: its first chunk, counted from 1, and the number of samples.
    const next = FULL_BOX + 4 + 12 * (run + 1);
    if (run + 1 < runs.getUint32(FULL_BOX) && runs.getUint32(next) === chunk + 1) run += 1;
    const count = runs.getUint32(FULL_BOX + 4 + 12 * run + 4);
    let offset = chunkOffset;
    for (const size of sizes.slice(samples.length, samples.length + count)) {
      const isKey = keyNumbers?.has(samples.length + 1) ?? true;
      samples.push({ isKey, data: bytes(part(file, offset, size)) });
      offset += size;
    }
  });
  if (samples.length !== sizes.length) throw new ClipUnplayable("The file lacks some of its frames.");
  return samples;
}

function sizesOf(table: View): number[] {
  const [common, count] = [table.getUint32(FULL_BOX), table.getUint32(FULL_BOX + 4)];
  return common ? new Array<number>(count).fill(common) : numbers(part(table, FULL_BOX + 8), count);
}

function offsetsOf(table: View): number[] {
  const found = box(table, "stco");
  return numbers(part(found, FULL_BOX + 4), found.getUint32(FULL_BOX));
}

function numbers(view: View, count: number): number[] {
  return Array.from({ length: count }, (_, index) => view.getUint32(4 * index));
}

/** The boxes in a part of the file by type; the first of each. */
function boxes(parent: View): Map<string, View> {
  const found = new Map<string, View>();
  for (let offset = 0; offset + 8 <= parent.byteLength; ) {
    const size = parent.getUint32(offset);
    const type = String.fromCharCode(...bytes(part(parent, offset + 4, 4)));
    // A size of 0 or 1 announces a file larger than 4 GB.
    if (size < 8)
      throw new ClipUnplayable(`The file is no mp4 file that Accord wrote: a box ${type} of ${size} bytes.`);
    if (!found.has(type)) found.set(type, part(parent, offset + 8, size - 8));
    offset += size;
  }
  return found;
}

function box(parent: View, type: string): View {
  const found = boxes(parent).get(type);
  if (!found) throw new ClipUnplayable(`The file has no ${type} box.`);
  return found;
}

function part(view: View, offset: number, length = view.byteLength - offset): View {
  return new DataView(view.buffer, view.byteOffset + offset, length);
}

function bytes(view: View): Uint8Array<ArrayBuffer> {
  return new Uint8Array(view.buffer, view.byteOffset, view.byteLength);
}
