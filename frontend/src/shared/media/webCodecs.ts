import { type Clip, type ClipSource, ClipUnplayable, close, frameSecondsOf } from "./clip";
import { readMp4 } from "./mp4";

/**
 * Decodes every frame of an mp4 file with the browser's video decoder, in a few tens of milliseconds.
 *
 * @throws ClipUnplayable, RangeError, or what the decoder throws
 */
export async function decodeWithWebCodecs(blob: Blob, source: ClipSource): Promise<Clip> {
  const { config, width, height, samples } = readMp4(await blob.arrayBuffer());
  const frameSeconds = frameSecondsOf(source);
  const bitmaps: Promise<ImageBitmap>[] = [];
  const decoder = new VideoDecoder({
    output: (frame) => bitmaps.push(createImageBitmap(frame).finally(() => frame.close())),
    // `flush` rejects with the same error.
    error: () => undefined,
  });
  try {
    decoder.configure(config);
    samples.forEach(({ isKey, data }, index) => {
      const timestamp = Math.round(index * frameSeconds * 1e6);
      decoder.decode(new EncodedVideoChunk({ type: isKey ? "key" : "delta", timestamp, data }));
    });
    await decoder.flush();
  } finally {
    if (decoder.state !== "closed") decoder.close();
  }
  const clip = { frames: await Promise.all(bitmaps), frameSeconds, width, height };
  if (clip.frames.length !== source.frames) {
    close(clip);
    throw new ClipUnplayable(`Decoded ${clip.frames.length} of ${source.frames} frames.`);
  }
  return clip;
}
