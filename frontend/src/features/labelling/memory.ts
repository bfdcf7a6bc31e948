import type { Answered } from "./queue";

/** What a reload of this tab must not forget: how many labels were given, and which can be undone. */
export interface Memory {
  labelled: number;
  past: readonly Answered[];
}

const NOTHING: Memory = { labelled: 0, past: [] };

export interface MemoryStorage {
  getItem(key: string): string | null;
  setItem(key: string, value: string): void;
}

export function remember(storage: MemoryStorage, key: string, memory: Memory): void {
  try {
    storage.setItem(key, JSON.stringify(memory));
  } catch (error) {
    console.warn("This browser stores nothing: a reload starts counting again.", error);
  }
}

export function recall(storage: MemoryStorage, key: string): Memory {
  try {
    return { ...NOTHING, ...(JSON.parse(storage.getItem(key) ?? "{}") as Partial<Memory>) };
  } catch (error) {
    console.warn("What this tab remembered could not be read.", error);
    return NOTHING;
  }
}
