import type { VideoSample } from "mediabunny";
import { type Clip, type ClipSource, ClipUnplayable, close, frameSecondsOf } from "./clip";
import { decodeBySeeking } from "./seek";

/**
 * Decodes every frame of an mp4 file.
 *
 * WebCodecs takes a few tens of milliseconds for a clip, but browsers offer it only on https and on localhost.
 * Elsewhere, and for a file that cannot be decoded this way, a hidden video element is seeked frame by frame.
 *
 * @throws ClipUnplayable
 */
export async function decodeClip(blob: Blob, source: ClipSource): Promise<Clip> {
  if ("VideoDecoder" in globalThis) {
    try {
      return await decodeWithWebCodecs(blob, source);
    } catch (error) {
      console.warn("WebCodecs could not decode a clip; falling back to a video element.", error);
    }
  }
  return decodeBySeeking(blob, source);
}

async function decodeWithWebCodecs(blob: Blob, source: ClipSource): Promise<Clip> {
  // Imported on first use: only the labelling page needs it.
  const { BufferSource, Input, MP4, VideoSampleSink } = await import("mediabunny");
  using input = new Input({ source: new BufferSource(await blob.arrayBuffer()), formats: [MP4] });
  const track = await input.getPrimaryVideoTrack();
  if (!track) throw new ClipUnplayable("The file has no video track.");
  const frames: ImageBitmap[] = [];
  const clip: Clip = {
    frames,
    frameSeconds: frameSecondsOf(source),
    width: await track.getDisplayWidth(),
    height: await track.getDisplayHeight(),
  };
  try {
    // Samples come in presentation order.
    for await (const sample of new VideoSampleSink(track).samples()) frames.push(await bitmapOf(sample));
    if (frames.length !== source.frames)
      throw new ClipUnplayable(`Decoded ${frames.length} of ${source.frames} frames.`);
  } catch (error) {
    close(clip);
    throw error;
  }
  return clip;
}

async function bitmapOf(sample: VideoSample): Promise<ImageBitmap> {
  const frame = sample.toVideoFrame();
  try {
    return await createImageBitmap(frame);
  } finally {
    frame.close();
    sample.close();
  }
}
