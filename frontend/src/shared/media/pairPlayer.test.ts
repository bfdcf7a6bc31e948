import { describe, expect, test } from "vitest";
import { defaultSpeed, frameAt, HOLD_SECONDS, PairClock } from "./pairPlayer";

const play = (clock: PairClock, seconds: number, hz = 60) => {
  for (let tick = 0; tick < Math.round(seconds * hz); tick++) clock.tick(1 / hz);
};

test.each([
  [2.5, 1],
  [1, 1],
  [0.75, 0.5],
  [0.4, 0.25],
  [0.1, 0.25],
])("a pair of %d s starts at speed %d", (seconds, speed) => {
  expect(defaultSpeed(seconds)).toBe(speed);
});

describe("PairClock", () => {
  test("a loop takes the clip and the hold, then restarts", () => {
    const clock = new PairClock(2.5, 0.05);
    play(clock, 2.4);
    expect(clock.position).toBeCloseTo(2.4);
    play(clock, 0.1 + HOLD_SECONDS / 2);
    expect(clock.position).toBe(2.5);
    play(clock, HOLD_SECONDS);
    expect(clock.loops).toBe(1);
    expect(clock.position).toBeLessThan(1);
  });

  test("double speed halves the clip but not the hold", () => {
    const clock = new PairClock(2, 0.05);
    clock.speed = 2;
    play(clock, 1 + HOLD_SECONDS - 0.05);
    expect(clock.loops).toBe(0);
    play(clock, 0.1);
    expect(clock.loops).toBe(1);
  });

  test("a paused clock does not advance", () => {
    const clock = new PairClock(2, 0.05);
    play(clock, 1);
    clock.paused = true;
    play(clock, 1);
    expect(clock.position).toBeCloseTo(1);
  });

  test("a hidden tab does not make the clips jump", () => {
    const clock = new PairClock(10, 0.05);
    clock.tick(60);
    expect(clock.position).toBeLessThan(0.5);
  });

  test("stepping visits every frame once in both directions and wraps around", () => {
    const clock = new PairClock(0.5, 0.05);
    const frames = () => frameAt(clock.position, 0.05, 10);
    const forwards = Array.from({ length: 11 }, () => {
      clock.step(1);
      return frames();
    });
    expect(forwards).toEqual([1, 2, 3, 4, 5, 6, 7, 8, 9, 0, 1]);
    clock.step(-1);
    clock.step(-1);
    expect(frames()).toBe(9);
    expect(clock.paused).toBe(true);
  });
});

describe("frameAt", () => {
  test("a shorter clip stays on its last frame", () => {
    expect(frameAt(2.0, 0.05, 20)).toBe(19);
  });

  test("the start of a frame belongs to that frame despite rounding", () => {
    for (let frame = 0; frame < 100; frame++) expect(frameAt(frame * 0.05, 0.05, 100)).toBe(frame);
  });
});
