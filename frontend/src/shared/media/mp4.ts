/** Where the frames of an H.264 mp4 lie, and when each is shown: what a decoder needs to be fed. */
export interface Mp4Track {
  /** WebCodecs' name of the codec, for example avc1.640015 */
  codec: string;
  /** the avcC box, which WebCodecs calls the description */
  description: Uint8Array;
  width: number;
  height: number;
  /** in decoding order */
  samples: Mp4Sample[];
}

export interface Mp4Sample {
  offset: number;
  size: number;
  /** seconds; the first shown frame of the track is at 0 */
  seconds: number;
  key: boolean;
}

/** Not an mp4 that this reader knows. Another way of decoding may still play it. */
export class Mp4Unreadable extends Error {}

interface Box {
  type: string;
  /** of the content, after the header */
  start: number;
  end: number;
}

/**
 * Reads the first H.264 track of a plain (not fragmented) mp4, as ISO/IEC 14496-12 describes it.
 *
 * Edit lists are passed over: frames are counted from the first one shown.
 *
 * @throws Mp4Unreadable
 */
export function readMp4(bytes: Uint8Array<ArrayBuffer>): Mp4Track {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  try {
    for (const trak of boxesOf(view, child(view, whole(view), "moov")).filter((box) => box.type === "trak")) {
      const track = readTrack(bytes, view, trak);
      if (track) return track;
    }
  } catch (error) {
    if (error instanceof RangeError) throw new Mp4Unreadable("The mp4 is cut short.");
    throw error;
  }
  throw new Mp4Unreadable("The mp4 has no H.264 track.");
}

function readTrack(bytes: Uint8Array, view: DataView, trak: Box): Mp4Track | null {
  const mdia = child(view, trak, "mdia");
  const stbl = child(view, child(view, mdia, "minf"), "stbl");
  const entry = boxesOf(view, skip(child(view, stbl, "stsd"), 8))[0];
  if (entry?.type !== "avc1") return null;
  const avcC = child(view, skip(entry, 78), "avcC");
  const description = bytes.slice(avcC.start, avcC.end);
  const profile = [...description.slice(1, 4)].map((byte) => byte.toString(16).padStart(2, "0"));
  return {
    codec: `avc1.${profile.join("")}`,
    description,
    width: view.getUint16(entry.start + 24),
    height: view.getUint16(entry.start + 26),
    samples: readSamples(view, stbl, timescaleOf(view, child(view, mdia, "mdhd"))),
  };
}

function timescaleOf(view: DataView, mdhd: Box): number {
  const version = view.getUint8(mdhd.start);
  return view.getUint32(mdhd.start + (version === 1 ? 20 : 12));
}

function readSamples(view: DataView, stbl: Box, timescale: number): Mp4Sample[] {
  const sizes = readSizes(view, child(view, stbl, "stsz"));
  const offsets = readOffsets(view, stbl, sizes);
  const decoded = runs(view, child(view, stbl, "stts"), sizes.length, "duration");
  const shifts = find(view, stbl, "ctts");
  const shift = shifts ? runs(view, shifts, sizes.length, "value") : sizes.map(() => 0);
  const keys = readKeys(view, find(view, stbl, "stss"));
  const shown = decoded.map((time, index) => time + (shift[index] ?? 0));
  const first = Math.min(...shown);
  return sizes.map((size, index) => ({
    offset: offsets[index] ?? 0,
    size,
    seconds: ((shown[index] ?? 0) - first) / timescale,
    key: keys === null || keys.has(index + 1),
  }));
}

function readSizes(view: DataView, stsz: Box): number[] {
  const common = view.getUint32(stsz.start + 4);
  const count = view.getUint32(stsz.start + 8);
  return Array.from({ length: count }, (_, index) => common || view.getUint32(stsz.start + 12 + 4 * index));
}

/** The place of every sample: chunks have their places, and within a chunk samples follow each other. */
function readOffsets(view: DataView, stbl: Box, sizes: number[]): number[] {
  const chunks = readChunks(view, stbl);
  const stsc = child(view, stbl, "stsc");
  const entries = view.getUint32(stsc.start + 4);
  const offsets: number[] = [];
  for (let entry = 0; entry < entries; entry++) {
    const at = stsc.start + 8 + 12 * entry;
    const firstChunk = view.getUint32(at);
    const perChunk = view.getUint32(at + 4);
    const nextFirst = entry + 1 < entries ? view.getUint32(at + 12) : chunks.length + 1;
    for (let chunk = firstChunk; chunk < nextFirst; chunk++) {
      let place = chunks[chunk - 1] ?? 0;
      for (let index = 0; index < perChunk; index++) {
        offsets.push(place);
        place += sizes[offsets.length - 1] ?? 0;
      }
    }
  }
  return offsets;
}

function readChunks(view: DataView, stbl: Box): number[] {
  const wide = find(view, stbl, "co64");
  const box = wide ?? child(view, stbl, "stco");
  return Array.from({ length: view.getUint32(box.start + 4) }, (_, index) =>
    wide ? Number(view.getBigUint64(box.start + 8 + 8 * index)) : view.getUint32(box.start + 8 + 4 * index),
  );
}

function readKeys(view: DataView, stss: Box | null): Set<number> | null {
  if (!stss) return null;
  const count = view.getUint32(stss.start + 4);
  return new Set(Array.from({ length: count }, (_, index) => view.getUint32(stss.start + 8 + 4 * index)));
}

/** Unrolls (count, number) pairs: summed up as durations are, or as they stand. */
function runs(view: DataView, box: Box, length: number, kind: "duration" | "value"): number[] {
  const unrolled: number[] = [];
  let time = 0;
  const pairs = view.getUint32(box.start + 4);
  for (let pair = 0; pair < pairs; pair++) {
    const at = box.start + 8 + 8 * pair;
    const value = kind === "value" ? view.getInt32(at + 4) : view.getUint32(at + 4);
    for (let left = view.getUint32(at); left > 0 && unrolled.length < length; left--) {
      unrolled.push(kind === "duration" ? time : value);
      time += value;
    }
  }
  return unrolled;
}

function whole(view: DataView): Box {
  return { type: "file", start: 0, end: view.byteLength };
}

function skip(box: Box, count: number): Box {
  return { ...box, start: box.start + count };
}

function boxesOf(view: DataView, parent: Box): Box[] {
  const boxes: Box[] = [];
  for (let at = parent.start; at + 8 <= parent.end; ) {
    const size32 = view.getUint32(at);
    const type = String.fromCharCode(...[4, 5, 6, 7].map((index) => view.getUint8(at + index)));
    const header = size32 === 1 ? 16 : 8;
    const size = size32 === 1 ? Number(view.getBigUint64(at + 8)) : size32 || parent.end - at;
    if (size < header) throw new Mp4Unreadable(`The mp4 has a broken box ${type}.`);
    boxes.push({ type, start: at + header, end: Math.min(at + size, parent.end) });
    at += size;
  }
  return boxes;
}

function find(view: DataView, parent: Box, type: string): Box | null {
  return boxesOf(view, parent).find((box) => box.type === type) ?? null;
}

function child(view: DataView, parent: Box, type: string): Box {
  const box = find(view, parent, type);
  if (!box) throw new Mp4Unreadable(`The mp4 has no box ${type}.`);
  return box;
}
