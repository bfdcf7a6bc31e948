import { type RefObject, useCallback, useLayoutEffect, useRef, useState } from "react";
import { type Clip, type ClipSource, ClipUnreachable, DecoderMissing } from "./clip";
import type { ClipCache } from "./clipCache";
import { defaultSpeed, PairPlayer } from "./pairPlayer";

type Canvas = RefObject<HTMLCanvasElement | null>;

export interface PairPlayback {
  state: "loading" | "playing" | "failed";
  error: string | null;
  paused: boolean;
  speed: number;
  /** length of the pair at full speed if that is too short to compare; otherwise null */
  shortSeconds: number | null;
  /** width over height of the clips */
  aspectRatio: number;
  /** seconds since both clips started to play; null before that */
  watchedSeconds: () => number | null;
  togglePause: () => void;
  step: (direction: 1 | -1) => void;
  /** pauses at a time within the loop */
  seek: (seconds: number) => void;
  setSpeed: (speed: number) => void;
  /** calls back after every draw with the position; returns a function that ends it */
  onDraw: (listener: DrawListener) => () => void;
  retry: () => void;
}

/** @param fraction of the loop */
export type DrawListener = (fraction: number, seconds: number) => void;

const SPEED_KEY = "accord.speed";
const DEFAULT_ASPECT_RATIO = 4 / 3;
/** Delay before clips are loaded again after the server did not respond. */
const RETRY_SECONDS = 2;

/** The speed that the user chose in this browser; null when they never did. */
function savedSpeed(): number | null {
  return Number(localStorage.getItem(SPEED_KEY)) || null;
}

/**
 * Plays a pair on two canvases.
 *
 * @param displayCount changes with every pair displayed, so that a pair displayed again restarts from its first frame.
 */
export function usePairPlayer(
  clips: ClipCache,
  left: ClipSource | null,
  right: ClipSource | null,
  displayCount: number,
  canvases: { left: Canvas; right: Canvas; progress: RefObject<HTMLElement | null> },
): PairPlayback {
  const player = useRef<PairPlayer | null>(null);
  const listeners = useRef(new Set<DrawListener>());
  const startedAt = useRef<number | null>(null);
  /** the `displayCount` for which it started: changing the camera does not start the pair anew */
  const startedFor = useRef<number | null>(null);
  const [state, setState] = useState<PairPlayback["state"]>("loading");
  const [error, setError] = useState<string | null>(null);
  const [paused, setPaused] = useState(false);
  const [speed, setSpeedState] = useState(() => savedSpeed() ?? 1);
  const [shortSeconds, setShortSeconds] = useState<number | null>(null);
  const [aspectRatio, setAspectRatio] = useState(DEFAULT_ASPECT_RATIO);
  const [attempt, setAttempt] = useState(0);
  const { left: leftCanvas, right: rightCanvas, progress } = canvases;

  // A layout effect, so that a pair decoded ahead is drawn in the repaint that shows it.
  // biome-ignore lint/correctness/useExhaustiveDependencies: `displayCount` and `attempt` restart the pair
  useLayoutEffect(() => {
    let unmounted = false;
    setError(null);
    setPaused(false);
    if (startedFor.current !== displayCount) startedAt.current = null;
    if (!left || !right) {
      setState("loading");
      return;
    }
    let retryTimer: ReturnType<typeof setTimeout> | undefined;
    const play = ([leftClip, rightClip]: [Clip, Clip]) => {
      if (unmounted || !leftCanvas.current || !rightCanvas.current) return;
      leftCanvas.current.dataset.clip = left.url;
      rightCanvas.current.dataset.clip = right.url;
      player.current = new PairPlayer(
        { canvas: leftCanvas.current, clip: leftClip },
        { canvas: rightCanvas.current, clip: rightClip },
        (fraction, seconds) => {
          progress.current?.style.setProperty("--progress", String(fraction));
          for (const listener of listeners.current) listener(fraction, seconds);
        },
      );
      const { clock } = player.current;
      clock.speed = savedSpeed() ?? defaultSpeed(clock.seconds);
      setSpeedState(clock.speed);
      setShortSeconds(defaultSpeed(clock.seconds) < 1 ? clock.seconds : null);
      startedAt.current ??= performance.now();
      startedFor.current = displayCount;
      setAspectRatio(leftClip.width / leftClip.height);
      setError(null);
      setState("playing");
    };
    const fail = (reason: Error) => {
      if (unmounted) return;
      // The messages of decoders are for programmers.
      if (!(reason instanceof ClipUnreachable)) console.warn("A clip cannot be played.", reason);
      const isKnown = reason instanceof ClipUnreachable || reason instanceof DecoderMissing;
      setError(isKnown ? reason.message : "One of its clips is missing or damaged.");
      setState("failed");
      if (reason instanceof ClipUnreachable) retryTimer = setTimeout(load, RETRY_SECONDS * 1000);
    };
    const load = () => void Promise.all([clips.load(left), clips.load(right)]).then(play, fail);
    const [leftReady, rightReady] = [clips.ready(left), clips.ready(right)];
    if (leftReady && rightReady) play([leftReady, rightReady]);
    else {
      setState("loading");
      load();
    }
    return () => {
      unmounted = true;
      clearTimeout(retryTimer);
      player.current?.stop();
      player.current = null;
    };
  }, [clips, left?.url, right?.url, displayCount, attempt]);

  const togglePause = useCallback(() => {
    const clock = player.current?.clock;
    if (!clock) return;
    clock.paused = !clock.paused;
    setPaused(clock.paused);
  }, []);
  const step = useCallback((direction: 1 | -1) => {
    player.current?.step(direction);
    setPaused(player.current?.clock.paused ?? false);
  }, []);
  const seek = useCallback((seconds: number) => {
    player.current?.seek(seconds);
    setPaused(player.current?.clock.paused ?? false);
  }, []);
  const onDraw = useCallback((listener: DrawListener) => {
    listeners.current.add(listener);
    return () => {
      listeners.current.delete(listener);
    };
  }, []);
  const setSpeed = useCallback((chosen: number) => {
    if (player.current) player.current.clock.speed = chosen;
    localStorage.setItem(SPEED_KEY, String(chosen));
    setSpeedState(chosen);
  }, []);
  const watchedSeconds = useCallback(
    () => (startedAt.current === null ? null : (performance.now() - startedAt.current) / 1000),
    [],
  );
  const retry = useCallback(() => setAttempt((count) => count + 1), []);
  return {
    state,
    error,
    paused,
    speed,
    shortSeconds,
    aspectRatio,
    watchedSeconds,
    togglePause,
    step,
    setSpeed,
    retry,
    seek,
    onDraw,
  };
}
