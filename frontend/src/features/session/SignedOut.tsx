import { useState } from "react";
import type { Me } from "@/shared/api/types";
import { countStoredLabels } from "@/shared/outbox/store";
import { CopyLine } from "@/shared/ui/CopyLine";
import { plural } from "@/shared/ui/format";
import { Message } from "@/shared/ui/Message";
import { ProviderSignIn } from "./ProviderSignIn";

const COMMAND = "accord link";

interface SignedOutProps {
  previous: Me | undefined;
  usedLink?: boolean;
}

/**
 * The sign-in page: why nobody is signed in, what happens to unsent labels, and where one-time links come from.
 *
 * @param previous the user who was signed in on this page until now; undefined if there was none.
 * @param usedLink whether a link brought them here that is not valid.
 */
export function SignedOut({ previous, usedLink = false }: SignedOutProps) {
  const [unsent] = useState(() => countStoredLabels(window.localStorage));
  return (
    <Message title={previous ? "You are signed out" : "Sign in to Accord"}>
      {usedLink && (
        <p className="alert" role="alert">
          This sign-in link has been used or has expired. Each link works once, and only for a limited time.
        </p>
      )}
      {previous && (
        <p role="alert">
          {previous.name} was signed out of this browser, here, in another tab or by an admin, or the session
          has expired.
        </p>
      )}
      {unsent > 0 && (
        <p data-testid="kept-labels">
          <strong>{plural(unsent, "label")} not sent yet.</strong> They are kept in this browser and are sent
          as soon as
          {previous ? ` ${previous.name} signs` : " you sign"} in here again. Do not clear the browser’s data
          before.
        </p>
      )}
      <ProviderSignIn wasSignedIn={previous !== undefined} />
      <p>
        Accord has no passwords. You sign in with a one-time link, and this browser stays signed in. Open the
        link in this browser, in any tab: this page then continues by itself.
      </p>
      <ul className="bullets">
        <li>
          If a colleague runs Accord, ask them for a new link
          {previous ? (
            <>
              . They create it with <code>accord user link {shellQuoted(previous.name)}</code>.
            </>
          ) : (
            <>
              . They create it with <code>accord user add NAME</code>, or with{" "}
              <code>accord user link NAME</code> if you have signed in before.
            </>
          )}
        </li>
        <li>
          If you run Accord on this machine, run this command in a terminal and open the link that it prints.
          It signs you in as the admin.
          <CopyLine text={COMMAND} />
        </li>
      </ul>
    </Message>
  );
}

/** A name as an argument of a command. */
function shellQuoted(name: string): string {
  return /^[\w.-]+$/.test(name) ? name : `'${name.replaceAll("'", `'"'"'`)}'`;
}
