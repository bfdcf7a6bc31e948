import type { Clip } from "./clip";
import { frameAt, PairClock } from "./clock";

export interface Side {
  canvas: HTMLCanvasElement;
  clip: Clip;
}

/**
 * Plays two clips on one clock: in every animation frame both are drawn from the same reading of it.
 *
 * What was drawn is written to the canvases as `data-frame`, and the largest distance that the two ever had, in
 * frames, to `data-max-drift` of the left one's nearest `[data-stage]`: anyone can check that they stay in step. A
 * canvas has `data-ended` while its clip, the shorter one, waits on its last frame for the other.
 */
export class PairPlayer {
  readonly clock: PairClock;
  readonly #left: Side;
  readonly #right: Side;
  readonly #onDraw: (position: number) => void;
  readonly #stage: HTMLElement | null;
  readonly #drawn = { left: -1, right: -1 };
  #maxDrift = 0;
  #lastTime: number | null = null;
  #request = 0;

  constructor(left: Side, right: Side, onDraw: (position: number) => void) {
    const seconds = Math.max(secondsOf(left.clip), secondsOf(right.clip));
    this.clock = new PairClock(seconds, left.clip.frameSeconds);
    this.#left = left;
    this.#right = right;
    this.#onDraw = onDraw;
    this.#stage = left.canvas.closest<HTMLElement>("[data-stage]");
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

  readonly #tick = (now: number): void => {
    if (this.#lastTime !== null) this.clock.tick((now - this.#lastTime) / 1000);
    this.#lastTime = now;
    this.#draw();
    this.#request = requestAnimationFrame(this.#tick);
  };

  #draw(): void {
    this.#drawn.left = paint(this.#left, this.clock.at, this.#drawn.left);
    this.#drawn.right = paint(this.#right, this.clock.at, this.#drawn.right);
    for (const { canvas, clip } of [this.#left, this.#right]) {
      const seconds = secondsOf(clip);
      canvas.toggleAttribute("data-ended", seconds < this.clock.seconds && this.clock.at >= seconds);
    }
    this.#maxDrift = Math.max(this.#maxDrift, this.#drift());
    if (this.#stage) {
      this.#stage.dataset.maxDrift = String(this.#maxDrift);
      this.#stage.dataset.loops = String(this.clock.loops);
    }
    this.#onDraw(this.clock.at / this.clock.seconds);
  }

  /** Frames between the two pictures on screen; a shorter clip that waits on its last frame is where it should be. */
  #drift(): number {
    const shorter = Math.min(this.#left.clip.frames.length, this.#right.clip.frames.length);
    const { left, right } = this.#drawn;
    return Math.abs(Math.min(left, shorter - 1) - Math.min(right, shorter - 1));
  }
}

function secondsOf(clip: Clip): number {
  return clip.frames.length * clip.frameSeconds;
}

/** Draws the frame of a time, if it is not there already. Returns its number. */
function paint({ canvas, clip }: Side, seconds: number, drawn: number): number {
  const frame = frameAt(seconds, clip.frameSeconds, clip.frames.length);
  const picture = clip.frames[frame];
  if (frame === drawn || !picture) return drawn;
  canvas.getContext("2d")?.drawImage(picture, 0, 0);
  canvas.dataset.frame = String(frame);
  return frame;
}
