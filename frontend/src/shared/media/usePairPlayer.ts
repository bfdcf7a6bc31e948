import { type RefObject, useCallback, useEffect, useRef, useState } from "react";
import { type Clip, type ClipSource, ClipUnreachable } from "./clip";
import type { Clips } from "./clips";
import { usualSpeed } from "./clock";
import { PairPlayer } from "./player";

type Canvas = RefObject<HTMLCanvasElement | null>;

export interface PairPlayback {
  state: "loading" | "playing" | "failed";
  trouble: string | null;
  paused: boolean;
  speed: number;
  ratio: number;
  /** seconds since both clips of this pair began to play; null before */
  watchedSeconds: () => number | null;
  togglePause: () => void;
  step: (direction: 1 | -1) => void;
  setSpeed: (speed: number) => void;
  retry: () => void;
}

const SPEED_KEY = "accord.speed";
const USUAL_RATIO = 4 / 3;
/** How long a pair that the server did not give waits before it asks again by itself. */
const RETRY_SECONDS = 2;

/** What this browser's labeller chose, now or earlier; null for nothing yet. */
function chosenSpeed(): number | null {
  return Number(localStorage.getItem(SPEED_KEY)) || null;
}

/**
 * Plays a pair on two canvases.
 *
 * @param shown changes with every pair put on screen, so that a pair that comes back begins anew.
 */
export function usePairPlayer(
  clips: Clips,
  left: ClipSource | null,
  right: ClipSource | null,
  shown: number,
  canvases: { left: Canvas; right: Canvas; position: RefObject<HTMLElement | null> },
): PairPlayback {
  const player = useRef<PairPlayer | null>(null);
  const startedAt = useRef<number | null>(null);
  const [state, setState] = useState<PairPlayback["state"]>("loading");
  const [trouble, setTrouble] = useState<string | null>(null);
  const [paused, setPaused] = useState(false);
  const [speed, setSpeedState] = useState(() => chosenSpeed() ?? 1);
  const [ratio, setRatio] = useState(USUAL_RATIO);
  const [attempt, setAttempt] = useState(0);
  const { left: leftCanvas, right: rightCanvas, position } = canvases;

  // biome-ignore lint/correctness/useExhaustiveDependencies: `shown` and `attempt` start the pair anew on purpose
  useEffect(() => {
    let gone = false;
    setState("loading");
    setTrouble(null);
    setPaused(false);
    if (!left || !right) return;
    let waiting: ReturnType<typeof setTimeout> | undefined;
    const play = ([leftClip, rightClip]: [Clip, Clip]) => {
      if (gone || !leftCanvas.current || !rightCanvas.current) return;
      player.current = new PairPlayer(
        { canvas: leftCanvas.current, clip: leftClip },
        { canvas: rightCanvas.current, clip: rightClip },
        (share) => position.current?.style.setProperty("--position", String(share)),
      );
      const { clock } = player.current;
      clock.speed = chosenSpeed() ?? usualSpeed(clock.seconds);
      setSpeedState(clock.speed);
      startedAt.current = performance.now();
      setRatio(leftClip.width / leftClip.height);
      setTrouble(null);
      setState("playing");
    };
    const fail = (error: Error) => {
      if (gone) return;
      setTrouble(error.message);
      setState("failed");
      if (error instanceof ClipUnreachable) waiting = setTimeout(begin, RETRY_SECONDS * 1000);
    };
    const begin = () => void Promise.all([clips.load(left), clips.load(right)]).then(play, fail);
    begin();
    return () => {
      gone = true;
      clearTimeout(waiting);
      player.current?.stop();
      player.current = null;
      startedAt.current = null;
    };
  }, [clips, left?.url, right?.url, shown, attempt]);

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
  const setSpeed = useCallback((wanted: number) => {
    if (player.current) player.current.clock.speed = wanted;
    localStorage.setItem(SPEED_KEY, String(wanted));
    setSpeedState(wanted);
  }, []);
  const watchedSeconds = useCallback(
    () => (startedAt.current === null ? null : (performance.now() - startedAt.current) / 1000),
    [],
  );
  const retry = useCallback(() => setAttempt((count) => count + 1), []);
  return { state, trouble, paused, speed, ratio, watchedSeconds, togglePause, step, setSpeed, retry };
}
