import { useQuery } from "@tanstack/react-query";
import { providerQuery } from "@/shared/api/queries";

/** What the server appends to the page's address if a sign-in through the provider fails. */
const REASONS: Record<string, string> = {
  sign_in_refused: "knows you, but you have no access to Accord. Ask an admin of Accord for it.",
  provider_unreachable: "does not answer. Try again later, or ask for a sign-in link.",
  too_many_failed_sign_ins: "was asked too often from your address. Wait a minute, then try again.",
};
const FAILED = "did not confirm who you are, or the sign-in took too long. Try again.";

/**
 * The button that leads to the identity provider, if there is one, and why the last sign-in through it failed.
 *
 * @param wasSignedIn whether somebody has signed out here; their session at the provider may go on.
 */
export function ProviderSignIn({ wasSignedIn }: { wasSignedIn: boolean }) {
  const name = useQuery(providerQuery).data?.name;
  if (!name) return null;
  const { pathname, search } = window.location;
  const error = new URLSearchParams(search).get("sign_in_error");
  const next = error === null ? pathname + search : pathname;
  return (
    <>
      {error !== null && (
        <p className="alert" role="alert">
          {capitalised(name)} {REASONS[error] ?? FAILED}
        </p>
      )}
      <p>
        <a className="button primary" href={`/api/v1/oidc/start?next=${encodeURIComponent(next)}`}>
          Sign in with {name}
        </a>
      </p>
      {wasSignedIn && (
        <p className="muted">
          On a shared computer, <a href="/api/v1/oidc/sign-out">sign out of {name}</a> too.
        </p>
      )}
    </>
  );
}

function capitalised(text: string): string {
  return text.charAt(0).toUpperCase() + text.slice(1);
}
