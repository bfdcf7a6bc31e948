/** A clip as pictures in memory: any frame can be drawn at once, forwards and backwards. */
export interface Clip {
  frames: ImageBitmap[];
  frameSeconds: number;
  width: number;
  height: number;
}

/** What is known of a clip before it is loaded. */
export interface ClipSource {
  url: string;
  frames: number;
  seconds: number;
}

export function bytesOf(clip: Clip): number {
  return clip.width * clip.height * 4 * clip.frames.length;
}

export function close(clip: Clip): void {
  for (const frame of clip.frames) frame.close();
}

/** The clip could not be loaded or decoded. */
export class ClipUnplayable extends Error {}

/** The clip could not be loaded because the server does not answer, which passes. */
export class ClipUnreached extends ClipUnplayable {}
