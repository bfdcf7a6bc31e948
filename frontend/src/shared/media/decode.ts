import { type Clip, type ClipSource, ClipUnplayable } from "./clip";
import { type Mp4Track, readMp4 } from "./mp4";

/**
 * All frames of an mp4.
 *
 * WebCodecs decodes a clip in a few tens of milliseconds, but browsers offer it on https and localhost alone;
 * elsewhere, and for an mp4 that our reader does not know, a hidden video element is sought frame by frame.
 *
 * @throws ClipUnplayable
 */
export async function decodeClip(blob: Blob, source: ClipSource): Promise<Clip> {
  if ("VideoDecoder" in globalThis) {
    try {
      return await decodeWithCodecs(new Uint8Array(await blob.arrayBuffer()));
    } catch (error) {
      console.warn("WebCodecs could not decode a clip; falling back to a video element.", error);
    }
  }
  return decodeBySeeking(blob, source);
}

async function decodeWithCodecs(bytes: Uint8Array<ArrayBuffer>): Promise<Clip> {
  const track = readMp4(bytes);
  const pictures: Promise<{ microseconds: number; bitmap: ImageBitmap }>[] = [];
  let failure: DOMException | null = null;
  const decoder = new VideoDecoder({
    output: (frame) => pictures.push(pictureOf(frame)),
    error: (error) => {
      failure = error;
    },
  });
  try {
    decoder.configure({ codec: track.codec, description: track.description });
    for (const chunk of chunksOf(track, bytes)) decoder.decode(chunk);
    await decoder.flush();
  } finally {
    if (decoder.state !== "closed") decoder.close();
  }
  const frames = await Promise.all(pictures);
  if (failure || frames.length !== track.samples.length) {
    for (const { bitmap } of frames) bitmap.close();
    throw new ClipUnplayable(`Decoded ${frames.length} of ${track.samples.length} frames.`, {
      cause: failure,
    });
  }
  frames.sort((a, b) => a.microseconds - b.microseconds);
  return {
    frames: frames.map(({ bitmap }) => bitmap),
    frameSeconds: frameSecondsOf(track),
    width: track.width,
    height: track.height,
  };
}

async function pictureOf(frame: VideoFrame): Promise<{ microseconds: number; bitmap: ImageBitmap }> {
  const microseconds = frame.timestamp;
  try {
    return { microseconds, bitmap: await createImageBitmap(frame) };
  } finally {
    frame.close();
  }
}

function chunksOf(track: Mp4Track, bytes: Uint8Array<ArrayBuffer>): EncodedVideoChunk[] {
  return track.samples.map(
    ({ offset, size, seconds, key }) =>
      new EncodedVideoChunk({
        type: key ? "key" : "delta",
        timestamp: Math.round(seconds * 1e6),
        data: bytes.subarray(offset, offset + size),
      }),
  );
}

/** Clips have a constant rate: the mean distance of frames is the distance. */
function frameSecondsOf(track: Mp4Track): number {
  const last = Math.max(...track.samples.map(({ seconds }) => seconds));
  return track.samples.length > 1 ? last / (track.samples.length - 1) : 0.05;
}

async function decodeBySeeking(blob: Blob, source: ClipSource): Promise<Clip> {
  const address = URL.createObjectURL(blob);
  const video = document.createElement("video");
  video.muted = true;
  video.preload = "auto";
  try {
    const loaded = once(video, "loadeddata");
    video.src = address;
    await loaded;
    const frameSeconds = source.seconds / source.frames;
    const frames: ImageBitmap[] = [];
    for (let index = 0; index < source.frames; index++) {
      const sought = once(video, "seeked");
      video.currentTime = (index + 0.5) * frameSeconds;
      await sought;
      frames.push(await createImageBitmap(video));
    }
    return { frames, frameSeconds, width: video.videoWidth, height: video.videoHeight };
  } finally {
    video.removeAttribute("src");
    video.load();
    URL.revokeObjectURL(address);
  }
}

function once(video: HTMLVideoElement, event: "loadeddata" | "seeked"): Promise<void> {
  return new Promise((resolve, reject) => {
    video.addEventListener(event, () => resolve(), { once: true });
    video.addEventListener(
      "error",
      () => reject(new ClipUnplayable(video.error?.message ?? "The browser cannot play this clip.")),
      { once: true },
    );
  });
}
