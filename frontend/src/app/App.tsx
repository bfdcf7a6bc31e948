import { QueryCache, QueryClient, QueryClientProvider, useQuery } from "@tanstack/react-query";
import { SignedOut } from "@/features/session/SignedOut";
import { ApiError, sentenceOf } from "@/shared/api/errors";
import { meQuery, shouldRetry } from "@/shared/api/queries";
import { OutboxProvider } from "@/shared/outbox/context";
import { Message } from "@/shared/ui/Message";
import { Pages } from "./Pages";
import { Shell } from "./Shell";

const RECONNECT_MS = 2_000;

const cache = new QueryClient({
  defaultOptions: { queries: { retry: shouldRetry, staleTime: 1_000 } },
  queryCache: new QueryCache({
    // A sign-in that ran out shows in whichever request comes first: ask who we are, and the page follows.
    onError: (error, query) => {
      if (error instanceof ApiError && error.status === 401 && query.queryKey[0] !== "me") {
        void cache.resetQueries({ queryKey: meQuery.queryKey });
      }
    },
  }),
});

export function App() {
  return (
    <QueryClientProvider client={cache}>
      <SignedIn />
    </QueryClientProvider>
  );
}

function SignedIn() {
  const me = useQuery({ ...meQuery, refetchInterval: (query) => (query.state.error ? RECONNECT_MS : false) });
  // First: what was known of a user stays in the cache when the sign-in runs out.
  if (me.error instanceof ApiError && me.error.status === 401) return <SignedOut />;
  if (me.data) {
    return (
      <OutboxProvider userId={me.data.id}>
        <Shell me={me.data}>
          <Pages me={me.data} />
        </Shell>
      </OutboxProvider>
    );
  }
  if (me.error) {
    return (
      <Message title="Accord does not answer">
        <p>{sentenceOf(me.error)} This page goes on by itself as soon as it does.</p>
      </Message>
    );
  }
  return null;
}
