import { type RefObject, useCallback, useEffect, useRef, useState } from "react";
import { type Clip, type ClipSource, ClipUnreachable } from "./clip";
import type { ClipCache } from "./clipCache";
import { defaultSpeed, PairPlayer } from "./pairPlayer";

type Canvas = RefObject<HTMLCanvasElement | null>;

export interface PairPlayback {
  state: "loading" | "playing" | "failed";
  error: string | null;
  paused: boolean;
  speed: number;
  /** width over height of the clips */
  aspectRatio: number;
  /** seconds since both clips started to play; null before that */
  watchedSeconds: () => number | null;
  togglePause: () => void;
  step: (direction: 1 | -1) => void;
  setSpeed: (speed: number) => void;
  retry: () => void;
}

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
  const startedAt = useRef<number | null>(null);
  const [state, setState] = useState<PairPlayback["state"]>("loading");
  const [error, setError] = useState<string | null>(null);
  const [paused, setPaused] = useState(false);
  const [speed, setSpeedState] = useState(() => savedSpeed() ?? 1);
  const [aspectRatio, setAspectRatio] = useState(DEFAULT_ASPECT_RATIO);
  const [attempt, setAttempt] = useState(0);
  const { left: leftCanvas, right: rightCanvas, progress } = canvases;

  // biome-ignore lint/correctness/useExhaustiveDependencies: `displayCount` and `attempt` restart the pair
  useEffect(() => {
    let unmounted = false;
    setState("loading");
    setError(null);
    setPaused(false);
    if (!left || !right) return;
    let retryTimer: ReturnType<typeof setTimeout> | undefined;
    const play = ([leftClip, rightClip]: [Clip, Clip]) => {
      if (unmounted || !leftCanvas.current || !rightCanvas.current) return;
      player.current = new PairPlayer(
        { canvas: leftCanvas.current, clip: leftClip },
        { canvas: rightCanvas.current, clip: rightClip },
        (fraction) => progress.current?.style.setProperty("--progress", String(fraction)),
      );
      const { clock } = player.current;
      clock.speed = savedSpeed() ?? defaultSpeed(clock.seconds);
      setSpeedState(clock.speed);
      startedAt.current = performance.now();
      setAspectRatio(leftClip.width / leftClip.height);
      setError(null);
      setState("playing");
    };
    const fail = (reason: Error) => {
      if (unmounted) return;
      // The messages of decoders are for programmers.
      if (!(reason instanceof ClipUnreachable)) console.warn("A clip cannot be played.", reason);
      setError(
        reason instanceof ClipUnreachable ? reason.message : "One of its clips is missing or damaged.",
      );
      setState("failed");
      if (reason instanceof ClipUnreachable) retryTimer = setTimeout(load, RETRY_SECONDS * 1000);
    };
    const load = () => void Promise.all([clips.load(left), clips.load(right)]).then(play, fail);
    load();
    return () => {
      unmounted = true;
      clearTimeout(retryTimer);
      player.current?.stop();
      player.current = null;
      startedAt.current = null;
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
  return { state, error, paused, speed, aspectRatio, watchedSeconds, togglePause, step, setSpeed, retry };
}
