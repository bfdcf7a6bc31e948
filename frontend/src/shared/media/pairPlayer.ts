import type { Clip } from "./clip";

/** How long both clips stay on their last frame before they repeat. */
export const HOLD_SECONDS = 0.5;

/** Shorter pairs start at a lower speed: fifty steps of a walker take 0.4 s. */
const MIN_VIEWING_SECONDS = 0.9;

/** A late animation frame (a busy machine, a hidden tab) advances the clips by at most this. */
const MAX_TICK_SECONDS = 0.25;

/**
 * The playback position of a pair of clips.
 *
 * Both clips are drawn from the same position, so they cannot drift apart.
 */
export class PairClock {
  /** length of one loop in seconds, without the hold at its end */
  readonly seconds: number;
  readonly frameSeconds: number;
  loops = 0;
  paused = false;
  speed = 1;
  #position = 0;

  constructor(seconds: number, frameSeconds: number) {
    this.seconds = seconds;
    this.frameSeconds = frameSeconds;
  }

  /** Seconds since the start of the loop, at most its length: during the hold it stays at the end. */
  get position(): number {
    return Math.min(this.#position, this.seconds);
  }

  /** Advances by wall-clock time unless paused. The hold at the end takes the same time at every speed. */
  tick(elapsedSeconds: number): void {
    if (this.paused) return;
    const elapsed = Math.min(elapsedSeconds, MAX_TICK_SECONDS);
    const remaining = Math.max(0, this.seconds - this.#position);
    const untilEnd = remaining / this.speed;
    this.#position += elapsed <= untilEnd ? elapsed * this.speed : remaining + (elapsed - untilEnd);
    if (this.#position >= this.seconds + HOLD_SECONDS) {
      this.#position = 0;
      this.loops += 1;
    }
  }

  /** Pauses and moves to a time within the loop. */
  seek(seconds: number): void {
    this.paused = true;
    this.#position = Math.max(0, Math.min(this.seconds, seconds));
  }

  /** Pauses and moves one frame forward or back. Wraps around at the ends. */
  step(direction: 1 | -1): void {
    this.paused = true;
    const count = Math.max(1, Math.round(this.seconds / this.frameSeconds));
    const next = (frameAt(this.position, this.frameSeconds, count) + direction + count) % count;
    // The middle of the frame, so that rounding cannot select a neighbour.
    this.#position = (next + 0.5) * this.frameSeconds;
  }
}

/** The speed of a pair of this length until the user chooses one: 1, or less when the pair would be over too soon. */
export function defaultSpeed(seconds: number): number {
  return [1, 0.5].find((speed) => seconds / speed >= MIN_VIEWING_SECONDS) ?? 0.25;
}

/** The index of the frame at a time; the last one when the clip is shorter than that. */
export function frameAt(seconds: number, frameSeconds: number, count: number): number {
  return Math.max(0, Math.min(count - 1, Math.floor(seconds / frameSeconds + 1e-9)));
}

export interface PlayerSide {
  canvas: HTMLCanvasElement;
  clip: Clip;
}

/**
 * Plays two clips on one clock: every animation frame draws both from the same position.
 *
 * Data attributes make the synchronisation testable. Each canvas has the URL of its clip in `data-clip`
 * (`usePairPlayer`), the index of its frame in `data-frame`, and `data-ended` while the shorter clip waits on its last
 * frame. The nearest `[data-pair]` has the number of loops in `data-loops` and the largest distance between the two
 * clips so far, in frames, in `data-max-drift`.
 */
export class PairPlayer {
  readonly clock: PairClock;
  readonly #left: PlayerSide;
  readonly #right: PlayerSide;
  readonly #onDraw: (progress: number, seconds: number) => void;
  readonly #pair: HTMLElement | null;
  readonly #drawn = { left: -1, right: -1 };
  #maxDrift = 0;
  #lastTime: number | null = null;
  #request = 0;

  /** @param onDraw is called after every draw with the position as a fraction of the loop, and in seconds. */
  constructor(left: PlayerSide, right: PlayerSide, onDraw: (progress: number, seconds: number) => void) {
    const seconds = Math.max(secondsOf(left.clip), secondsOf(right.clip));
    this.clock = new PairClock(seconds, left.clip.frameSeconds);
    this.#left = left;
    this.#right = right;
    this.#onDraw = onDraw;
    this.#pair = left.canvas.closest<HTMLElement>("[data-pair]");
    for (const { canvas, clip } of [left, right]) {
      canvas.width = clip.width;
      canvas.height = clip.height;
    }
    this.#draw();
    this.#request = requestAnimationFrame(this.#tick);
  }

  stop(): void {
    cancelAnimationFrame(this.#request);
  }

  step(direction: 1 | -1): void {
    this.clock.step(direction);
    this.#draw();
  }

  seek(seconds: number): void {
    this.clock.seek(seconds);
    this.#draw();
  }

  readonly #tick = (now: number): void => {
    if (this.#lastTime !== null) this.clock.tick((now - this.#lastTime) / 1000);
    this.#lastTime = now;
    this.#draw();
    this.#request = requestAnimationFrame(this.#tick);
  };

  #draw(): void {
    const { position, seconds, loops } = this.clock;
    this.#drawn.left = drawFrame(this.#left, position, this.#drawn.left);
    this.#drawn.right = drawFrame(this.#right, position, this.#drawn.right);
    for (const { canvas, clip } of [this.#left, this.#right]) {
      const clipSeconds = secondsOf(clip);
      canvas.toggleAttribute("data-ended", clipSeconds < seconds && position >= clipSeconds);
    }
    this.#maxDrift = Math.max(this.#maxDrift, this.#drift());
    if (this.#pair) {
      this.#pair.dataset.maxDrift = String(this.#maxDrift);
      this.#pair.dataset.loops = String(loops);
    }
    this.#onDraw(position / seconds, position);
  }

  /** Distance between the frames on screen. A shorter clip that waits on its last frame does not count. */
  #drift(): number {
    const shorter = Math.min(this.#left.clip.frames.length, this.#right.clip.frames.length);
    const { left, right } = this.#drawn;
    return Math.abs(Math.min(left, shorter - 1) - Math.min(right, shorter - 1));
  }
}

function secondsOf(clip: Clip): number {
  return clip.frames.length * clip.frameSeconds;
}

/** Draws the frame at a time unless it is already on the canvas. Returns its index. */
function drawFrame({ canvas, clip }: PlayerSide, seconds: number, drawn: number): number {
  const index = frameAt(seconds, clip.frameSeconds, clip.frames.length);
  const bitmap = clip.frames[index];
  if (index === drawn || !bitmap) return drawn;
  canvas.getContext("2d")?.drawImage(bitmap, 0, 0);
  canvas.dataset.frame = String(index);
  return index;
}
