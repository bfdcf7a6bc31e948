/** What a labeller can say of a pair. */
export type Answer = "left" | "right" | "equal" | "skip";

/** The label of an answer in shown order: 1 means that the left clip is better; null skips. */
export const LABEL_OF: Readonly<Record<Answer, number | null>> = {
  left: 1,
  right: 0,
  equal: 0.5,
  skip: null,
};

export const WORDS: Readonly<Record<Answer, string>> = {
  left: "Left is better",
  right: "Right is better",
  equal: "Equally good",
  skip: "Skipped",
};

export type Command =
  | { do: "answer"; answer: Answer }
  | { do: "undo" }
  | { do: "pause" }
  | { do: "step"; direction: 1 | -1 }
  | { do: "speed"; speed: number };

export const SPEEDS = [
  { key: "0", speed: 0.25, words: "¼×" },
  { key: "1", speed: 0.5, words: "½×" },
  { key: "2", speed: 1, words: "1×" },
  { key: "3", speed: 2, words: "2×" },
] as const;

const COMMANDS: ReadonlyMap<string, Command> = new Map<string, Command>([
  ["ArrowLeft", { do: "answer", answer: "left" }],
  ["ArrowRight", { do: "answer", answer: "right" }],
  ["ArrowUp", { do: "answer", answer: "equal" }],
  ["ArrowDown", { do: "answer", answer: "skip" }],
  ["z", { do: "undo" }],
  ["Z", { do: "undo" }],
  [" ", { do: "pause" }],
  [",", { do: "step", direction: -1 }],
  [".", { do: "step", direction: 1 }],
  ...SPEEDS.map(({ key, speed }): [string, Command] => [key, { do: "speed", speed }]),
]);

interface Key {
  key: string;
  repeat: boolean;
  ctrlKey: boolean;
  metaKey: boolean;
  altKey: boolean;
}

/** What a key asks for. A held key steps frames on, but never labels a second pair. */
export function commandOf({ key, repeat, ctrlKey, metaKey, altKey }: Key): Command | null {
  const undoChord = (ctrlKey || metaKey) && !altKey && key.toLowerCase() === "z";
  if ((ctrlKey || metaKey || altKey) && !undoChord) return null;
  const command = COMMANDS.get(key) ?? null;
  return repeat && command?.do !== "step" ? null : command;
}
