import { type Clip, type ClipSource, ClipUnplayable, DecoderMissing, frameSecondsOf } from "./clip";

/** The longest wait for a seeked frame to be presented; it usually takes one or two repaints. */
const LONGEST_PRESENTATION_MS = 500;
/** H.264, high profile. */
const CLIP_TYPE = 'video/mp4; codecs="avc1.64001f"';

/**
 * Decodes every frame of a clip by seeking a hidden video element: slower than WebCodecs, but works in any browser.
 *
 * @throws ClipUnplayable
 */
export async function decodeBySeeking(blob: Blob, source: ClipSource): Promise<Clip> {
  const video = document.createElement("video");
  if (!video.canPlayType(CLIP_TYPE)) throw new DecoderMissing();
  const address = URL.createObjectURL(blob);
  video.muted = true;
  video.preload = "auto";
  try {
    const loaded = once(video, "loadeddata");
    video.src = address;
    await loaded;
    const frameSeconds = frameSecondsOf(source);
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

/** Resolves when the video shows this frame: "seeked" can fire while the previous frame is still on screen. */
async function seekFrame(video: HTMLVideoElement, index: number, frameSeconds: number): Promise<void> {
  const shown = presented(video, (mediaSeconds) => Math.round(mediaSeconds / frameSeconds) === index);
  const seeked = once(video, "seeked");
  video.currentTime = (index + 0.5) * frameSeconds;
  await seeked;
  await shown;
}

/** Resolves when the video presents a frame for which `isWanted` holds, or after LONGEST_PRESENTATION_MS. */
function presented(video: HTMLVideoElement, isWanted: (mediaSeconds: number) => boolean): Promise<void> {
  // Firefox supports it since version 132.
  if (!("requestVideoFrameCallback" in video)) return Promise.resolve();
  return new Promise((resolve) => {
    let handle = 0;
    const finish = (): void => {
      clearTimeout(timeout);
      video.cancelVideoFrameCallback(handle);
      resolve();
    };
    const request = (): void => {
      handle = video.requestVideoFrameCallback((_now, { mediaTime }) =>
        isWanted(mediaTime) ? finish() : request(),
      );
    };
    // A page in the background presents nothing, and a frame already on screen is not always presented again.
    const timeout = setTimeout(finish, LONGEST_PRESENTATION_MS);
    request();
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
