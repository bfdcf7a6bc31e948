import { useEffect, useState } from "react";

const COPIED_MS = 2_000;

/** A command or a link in one line, with a button that copies it where the browser allows that. */
export function CopyLine({ text }: { text: string }) {
  const [copied, setCopied] = useState(false);
  useEffect(() => {
    if (!copied) return;
    const timer = setTimeout(() => setCopied(false), COPIED_MS);
    return () => clearTimeout(timer);
  }, [copied]);
  return (
    <span className="command">
      <code>{text}</code>
      {"clipboard" in navigator && (
        <button
          type="button"
          className="button small"
          onClick={() => void navigator.clipboard.writeText(text).then(() => setCopied(true))}
        >
          {copied ? "Copied" : "Copy"}
        </button>
      )}
    </span>
  );
}
