/* The least of Zenoh's protocol (version 9, Zenoh 1.x) that a client of factorbus needs, over TCP: a session as a
 * client, queries, and subscriptions.
 *
 * It is here so that the example runs with nothing installed. On a robot take zenoh-c or zenoh-pico, which have
 * everything that this leaves out: reconnecting, TLS, discovery, several links, batches that wait for each other.
 */
#ifndef FACTORBUS_ZENOH_H
#define FACTORBUS_ZENOH_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef struct z_session z_session;

/* A publication that was subscribed to. Called while the session waits for something; it may not use the session. */
typedef void (*z_on_sample)(void *context, const char *key, const uint8_t *payload, size_t size);

typedef enum { Z_REPLY, Z_ERROR, Z_NOTHING, Z_BROKEN } z_outcome;

/* What came of a query: a reply, an error reply, no reply (the query has ended, or its time), or no connection any more.
 * `payload` is to be freed; it is NULL where there is none. */
typedef struct {
    z_outcome outcome;
    uint8_t *payload;
    size_t size;
} z_answer;

/* A session at host and port. NULL, and a line on standard error, if there is none to be had. */
z_session *z_open(const char *host, const char *port, z_on_sample on_sample, void *context);
void z_close(z_session *session);

bool z_subscribe(z_session *session, const char *key);
/* Declares a liveliness token: alive until the session ends. */
bool z_announce(z_session *session, const char *key);
/* The first reply counts. */
z_answer z_query(z_session *session, const char *key, const void *payload, size_t size, int timeout_ms);
/* A liveliness token that is there. As z_on_sample, it may not use the session. */
typedef void (*z_on_token)(void *context, const char *key);
/* Every liveliness token that `key`, an expression with wildcards, matches. False when the connection is gone. */
bool z_look(z_session *session, const char *key, z_on_token on_token, void *context, int timeout_ms);
/* Lets publications in for so long. False when the connection is gone. */
bool z_wait(z_session *session, int timeout_ms);

#endif
