import { useEffect, useState } from "react";
import { Message } from "@/shared/ui/Message";

const COMMAND = "accord link";

/** There are no passwords: a link signs one in, once. */
export function SignedOut() {
  return (
    <Message title="Sign in to Accord">
      <p>Accord has no passwords. A one-time link signs you in, and this browser stays signed in.</p>
      <ol>
        <li>
          If Accord runs on this machine, type this in its terminal and open the link that it prints:
          <CommandLine />
        </li>
        <li>If a colleague runs it, ask them for a link. They make it with the same command.</li>
      </ol>
      <p className="quiet">A link that was used or is old no longer works; a new one is made in a second.</p>
    </Message>
  );
}

function CommandLine() {
  const [copied, setCopied] = useState(false);
  useEffect(() => {
    if (!copied) return;
    const timer = setTimeout(() => setCopied(false), 2_000);
    return () => clearTimeout(timer);
  }, [copied]);
  return (
    <span className="command">
      <code>{COMMAND}</code>
      {"clipboard" in navigator && (
        <button
          type="button"
          className="button small"
          onClick={() => void navigator.clipboard.writeText(COMMAND).then(() => setCopied(true))}
        >
          {copied ? "Copied" : "Copy"}
        </button>
      )}
    </span>
  );
}
