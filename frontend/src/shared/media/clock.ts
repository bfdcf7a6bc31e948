/** Both clips stand still this long on their last frame before they begin again. */
export const HOLD_SECONDS = 0.5;

/** A pair that is over in less is shown slower at first: fifty steps of a walker are 0.4 s. */
const SHORTEST_SHOWN_SECONDS = 0.9;

/** A frame that came late (a busy machine, a hidden tab) moves the clips by no more than this. */
const LONGEST_TICK_SECONDS = 0.25;

/**
 * The one clock of a pair of clips.
 *
 * It knows only time; every clip is drawn from the same reading of it, so no clip can run ahead of the other.
 */
export class PairClock {
  /** seconds of one loop, without the hold at its end */
  readonly seconds: number;
  readonly frameSeconds: number;
  loops = 0;
  paused = false;
  speed = 1;
  #at = 0;

  constructor(seconds: number, frameSeconds: number) {
    this.seconds = seconds;
    this.frameSeconds = frameSeconds;
  }

  /** Seconds into the loop; on its last frame while it is held. */
  get at(): number {
    return Math.min(this.#at, this.seconds);
  }

  /** Moves on by wall time, if not paused. The hold at the end takes the same time at every speed. */
  tick(elapsedSeconds: number): void {
    if (this.paused) return;
    const elapsed = Math.min(elapsedSeconds, LONGEST_TICK_SECONDS);
    const inClip = Math.max(0, this.seconds - this.#at);
    const needed = inClip / this.speed;
    this.#at += elapsed <= needed ? elapsed * this.speed : inClip + (elapsed - needed);
    if (this.#at >= this.seconds + HOLD_SECONDS) {
      this.#at = 0;
      this.loops += 1;
    }
  }

  /** One frame forward or back, round the ends; pauses. */
  step(direction: 1 | -1): void {
    this.paused = true;
    const count = Math.max(1, Math.round(this.seconds / this.frameSeconds));
    const next = (frameAt(this.at, this.frameSeconds, count) + direction + count) % count;
    // The middle of a frame: rounding cannot fall to a neighbour.
    this.#at = (next + 0.5) * this.frameSeconds;
  }
}

/** How fast a pair of this length is shown to somebody who has not chosen: as it was, or slower if it were a blink. */
export function usualSpeed(seconds: number): number {
  return [1, 0.5].find((speed) => seconds / speed >= SHORTEST_SHOWN_SECONDS) ?? 0.25;
}

/** The frame of a clip at a time; its last one when it is shorter than the other clip. */
export function frameAt(seconds: number, frameSeconds: number, count: number): number {
  return Math.max(0, Math.min(count - 1, Math.floor(seconds / frameSeconds + 1e-9)));
}
