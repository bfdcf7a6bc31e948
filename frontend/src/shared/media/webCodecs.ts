import { BufferSource, Input, MP4, type VideoSample, VideoSampleSink } from "mediabunny";
import { type Clip, type ClipSource, ClipUnplayable, close, frameSecondsOf } from "./clip";

/**
 * Decodes every frame of an mp4 file with the browser's video decoder, in a few tens of milliseconds.
 *
 * Only the labelling page loads this module, and with it mediabunny.
 *
 * @throws ClipUnplayable, or what the decoder throws
 */
export async function decodeWithWebCodecs(blob: Blob, source: ClipSource): Promise<Clip> {
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
