import { useState } from "react";

const keyOf = (userId: string, experimentId: string) => `accord.rules.${userId}.${experimentId}`;

/**
 * The newest revision of the rules that this user has read in this browser; 0 for none.
 *
 * Without browser storage the rules are shown again after a reload.
 */
export function useSeenRules(userId: string, experimentId: string): [number, (revision: number) => void] {
  const key = keyOf(userId, experimentId);
  const [seen, setSeen] = useState(() => {
    try {
      return Number(localStorage.getItem(key)) || 0;
    } catch {
      return 0;
    }
  });
  const store = (revision: number) => {
    setSeen(revision);
    try {
      localStorage.setItem(key, String(revision));
    } catch (error) {
      console.warn("Browser storage is unavailable: the rules are shown again after a reload.", error);
    }
  };
  return [seen, store];
}
