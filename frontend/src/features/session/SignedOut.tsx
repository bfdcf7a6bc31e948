import { useEffect, useState } from "react";
import { Message } from "@/shared/ui/Message";

const COMMAND = "accord link";
const COPIED_MS = 2_000;

/** The sign-in page: explains where one-time sign-in links come from. */
export function SignedOut() {
  return (
    <Message title="Sign in to Accord">
      <p>Accord has no passwords. You sign in with a one-time link, and this browser stays signed in.</p>
      <ul className="bullets">
        <li>
          If you run Accord on this machine, run this command in a terminal and open the link that it prints.
          It signs you in as the admin.
          <CommandLine />
        </li>
        <li>
          If a colleague runs Accord, ask them for a link. They create it with{" "}
          <code>accord user add NAME</code>, or with <code>accord user link NAME</code> if you have signed in
          before.
        </li>
      </ul>
      <p className="muted">Each link works once, and only for a limited time.</p>
    </Message>
  );
}

function CommandLine() {
  const [copied, setCopied] = useState(false);
  useEffect(() => {
    if (!copied) return;
    const timer = setTimeout(() => setCopied(false), COPIED_MS);
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
