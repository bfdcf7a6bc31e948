import type { LabelledPair } from "./queue";

/** What survives a reload of the tab: the number of labels given, and the pairs that can be undone. */
export interface SavedState {
  labelCount: number;
  past: readonly LabelledPair[];
}

const EMPTY: SavedState = { labelCount: 0, past: [] };

/** The methods of sessionStorage that are used. */
export interface TabStorage {
  getItem(key: string): string | null;
  setItem(key: string, value: string): void;
}

export function saveState(storage: TabStorage, key: string, state: SavedState): void {
  try {
    storage.setItem(key, JSON.stringify(state));
  } catch (error) {
    console.warn("Browser storage is unavailable: a reload resets the label count and undo.", error);
  }
}

export function loadState(storage: TabStorage, key: string): SavedState {
  try {
    return { ...EMPTY, ...(JSON.parse(storage.getItem(key) ?? "{}") as Partial<SavedState>) };
  } catch (error) {
    console.warn("The saved state of this tab could not be read.", error);
    return EMPTY;
  }
}
