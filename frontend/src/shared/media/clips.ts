import { bytesOf, type Clip, type ClipSource, ClipUnplayable, ClipUnreachable, close } from "./clip";
import { decodeClip } from "./decode";

/** Decoded pictures of the clips in use stay under this; compressed ones are small and always kept. */
const DECODED_BYTES = 400_000_000;
const ATTEMPTS = 4;
const FIRST_WAIT_SECONDS = 0.5;

type Decode = (blob: Blob, source: ClipSource) => Promise<Clip>;

/** The clips on screen and those that come next: loaded and decoded ahead, dropped when nobody wants them. */
export class Clips {
  readonly #blobs = new Map<string, Promise<Blob>>();
  readonly #decoded = new Map<string, Promise<Clip>>();
  readonly #decode: Decode;
  #clipBytes = 0;

  constructor(decode: Decode = decodeClip) {
    this.#decode = decode;
  }

  /**
   * Says which clips are wanted, the most urgent first: all of them are loaded, as many decoded as fit in
   * memory, every other one forgotten.
   */
  want(sources: ClipSource[]): void {
    const wanted = new Set(sources.map(({ url }) => url));
    for (const url of this.#blobs.keys()) if (!wanted.has(url)) this.#forget(url);
    const room = Math.max(2, Math.floor(DECODED_BYTES / (this.#clipBytes || 1)));
    sources.forEach((source, place) => {
      const loading = place < room ? this.load(source) : this.#blob(source.url);
      // Failures are told to whoever shows the clip.
      loading.catch(() => undefined);
    });
  }

  /** A clip to show. A failed one is tried again by the next call. */
  load(source: ClipSource): Promise<Clip> {
    const { url } = source;
    let clip = this.#decoded.get(url);
    if (!clip) {
      clip = this.#blob(url).then((blob) => this.#decode(blob, source));
      clip.then(
        (ready) => {
          this.#clipBytes = bytesOf(ready);
        },
        () => this.#decoded.delete(url),
      );
      this.#decoded.set(url, clip);
    }
    return clip;
  }

  clear(): void {
    this.want([]);
  }

  #blob(url: string): Promise<Blob> {
    let blob = this.#blobs.get(url);
    if (!blob) {
      blob = download(url);
      blob.catch(() => this.#blobs.delete(url));
      this.#blobs.set(url, blob);
    }
    return blob;
  }

  #forget(url: string): void {
    this.#blobs.delete(url);
    this.#decoded.get(url)?.then(close, () => undefined);
    this.#decoded.delete(url);
  }
}

async function download(url: string): Promise<Blob> {
  let wait = FIRST_WAIT_SECONDS;
  for (let attempt = 1; ; attempt++) {
    try {
      const response = await fetch(url, { credentials: "same-origin" });
      if (response.ok) return await response.blob();
      if (response.status < 500)
        throw new ClipUnplayable(`The server answered ${response.status} for a clip.`);
    } catch (error) {
      if (error instanceof ClipUnplayable) throw error;
    }
    if (attempt === ATTEMPTS)
      throw new ClipUnreachable("The server does not answer for a clip; it goes on being asked.");
    await new Promise((resolve) => setTimeout(resolve, wait * 1000));
    wait *= 2;
  }
}
