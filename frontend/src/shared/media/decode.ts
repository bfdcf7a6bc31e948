import { type Clip, type ClipSource, ClipUnplayable } from "./clip";
import { type Mp4Track, readMp4 } from "./mp4";

/** How long a frame may take from the seek to the screen; it takes a repaint or two. */
const LONGEST_PRESENTATION_MS = 500;

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
      await seekFrame(video, index, frameSeconds);
      frames.push(await createImageBitmap(video));
    }
    return { frames, frameSeconds, width: video.videoWidth, height: video.videoHeight };
  } finally {
    video.removeAttribute("src");
    video.load();
    URL.revokeObjectURL(address);
  }
}

/** Resolves when the video shows this frame: "seeked" alone may come while it still shows the one before. */
async function seekFrame(video: HTMLVideoElement, index: number, frameSeconds: number): Promise<void> {
  const shown = presented(video, (mediaSeconds) => Math.round(mediaSeconds / frameSeconds) === index);
  const sought = once(video, "seeked");
  video.currentTime = (index + 0.5) * frameSeconds;
  await sought;
  await shown;
}

/** Resolves when the video presents a frame whose time is `right`, or after so long that it must have. */
function presented(video: HTMLVideoElement, right: (mediaSeconds: number) => boolean): Promise<void> {
  // Firefox has it since 132.
  if (!("requestVideoFrameCallback" in video)) return Promise.resolve();
  return new Promise((resolve) => {
    let asked = 0;
    const finish = (): void => {
      clearTimeout(patience);
      video.cancelVideoFrameCallback(asked);
      resolve();
    };
    const ask = (): void => {
      asked = video.requestVideoFrameCallback((_now, { mediaTime }) => (right(mediaTime) ? finish() : ask()));
    };
    // A page in the background presents nothing, and a frame that is shown already is not always presented again.
    const patience = setTimeout(finish, LONGEST_PRESENTATION_MS);
    ask();
  });
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
