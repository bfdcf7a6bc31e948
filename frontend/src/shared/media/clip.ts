/** A decoded clip: every frame is in memory, so that any of them can be drawn at once. */
export interface Clip {
  frames: ImageBitmap[];
  frameSeconds: number;
  width: number;
  height: number;
}

/** Where to load a clip from, and what the API says about it. */
export interface ClipSource {
  url: string;
  frames: number;
  seconds: number;
}

/** Where a clip is as an animated GIF, for messages and pages that play no video. */
export function gifUrl(clipUrl: string): string {
  return clipUrl.replace(/\.mp4$/, ".gif");
}

/** Clips have a constant frame rate. */
export function frameSecondsOf(source: ClipSource): number {
  return source.seconds / source.frames;
}

/** Memory of the decoded frames, four bytes per pixel. */
export function bytesOf(clip: Clip): number {
  return clip.width * clip.height * 4 * clip.frames.length;
}

/** Frees the memory of the frames. */
export function close(clip: Clip): void {
  for (const frame of clip.frames) frame.close();
}

/** The clip could not be loaded or decoded. */
export class ClipUnplayable extends Error {}

/** The clip could not be loaded because the server does not respond; a later attempt may succeed. */
export class ClipUnreachable extends ClipUnplayable {}

/** The browser cannot decode H.264, the format of all clips. */
export class DecoderMissing extends ClipUnplayable {
  constructor() {
    super(
      "This browser cannot decode H.264 video. On Linux, install ffmpeg and restart the browser; elsewhere, use another one.",
    );
  }
}
