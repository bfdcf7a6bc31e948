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
