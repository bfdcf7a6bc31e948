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
          If you run Accord on this machine, run this command in a terminal and open the link that it prints.
          It signs you in as the administrator:
          <CommandLine />
        </li>
        <li>
          If a colleague runs Accord, ask them for a sign-in link. They create it with{" "}
          <code>accord user link NAME</code>, or with <code>accord user add NAME</code> if you are new.
        </li>
      </ol>
      <p className="quiet">Each link works once, and only for a limited time.</p>
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
