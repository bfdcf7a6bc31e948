import { Key } from "@/shared/ui/Key";
import { type ClipNames, choiceText } from "./layout";
import type { AnsweredPair } from "./queue";

interface ReviewBannerProps {
  pair: AnsweredPair;
  names: ClipNames;
  onClose: () => void;
}

/** Says that an answered pair is on screen, and how to keep or change its label. */
export function ReviewBanner({ pair, names, onClose }: ReviewBannerProps) {
  return (
    <div className="review-banner" role="status">
      <h1>
        Pair {pair.query.number}, answered “{choiceText(pair.choice, names)}”. Answer again to change it.
      </h1>
      <button type="button" className="button small" onClick={onClose}>
        <Key name="Esc" /> Keep it
      </button>
    </div>
  );
}
