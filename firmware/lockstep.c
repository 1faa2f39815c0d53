// SPDX-License-Identifier: GPL-3.0-or-later
// Betaflight's SITL under a virtual clock that only this file advances: one thread, no sockets but the one to
// its host, which it is given as its standard input. No file of the firmware is edited: sitl.c is included
// with its clock, threads and start renamed away, voltage.c with an ADC. This file is compiled instead of
// them and of drivers/serial_tcp.c; EEPROM, motors and IO stay the firmware's own.
#define systemInit sitl_systemInit
#define systemReset sitl_systemReset
#define systemResetToBootloader sitl_systemResetToBootloader
#define nanos64_real sitl_nanos64_real
#define micros64_real sitl_micros64_real
#define millis64_real sitl_millis64_real
#define micros64 sitl_micros64
#define millis64 sitl_millis64
#define micros sitl_micros
#define millis sitl_millis
#define getCycleCounter sitl_getCycleCounter
#define delayMicroseconds sitl_delayMicroseconds
#define delayMicroseconds_real sitl_delayMicroseconds_real
#define delay sitl_delay
#define adcGetChannel sitl_adcGetChannel
#include <pthread.h>
#include <stdbool.h>
#include "platform.h"
#include "udplink.h"
#define pthread_mutex_trylock(lock) nothing(lock)
#define pthread_mutex_unlock(lock) nothing(lock)
#define udpSend(link, data, size) nothing(link)
static inline int nothing(void *unused) { (void)unused; return 0; }
#include "sitl.c"
#undef systemInit
#undef systemReset
#undef systemResetToBootloader
#undef nanos64_real
#undef micros64_real
#undef millis64_real
#undef micros64
#undef millis64
#undef micros
#undef millis
#undef getCycleCounter
#undef delayMicroseconds
#undef delayMicroseconds_real
#undef delay
#undef adcGetChannel
#include "drivers/adc.h"
uint16_t adcGetChannel(uint8_t channel);
uint32_t millis(void);
#define USE_ADC
#include "sensors/voltage.c"
#undef USE_ADC

#include <signal.h>
#include <sys/socket.h>
#include <unistd.h>
#include "body.h"
#include "drivers/serial_tcp.h"
#include "fc/runtime_config.h"
#include "flight/mixer_init.h"

extern const char *armingDisableFlagNames[];

// What the host asks for; firmware/process.py packs and unpacks the same.
enum { ASK_CLI, ASK_BODY, ASK_START, ASK_FLY, ASK_FORK };

typedef struct {
    uint32_t kind;
    uint32_t duration_us;  // of CLI and FLY
    uint32_t frame_us;     // between two frames of the receiver; 0: none
    uint32_t is_held;      // the body stays where it is
    uint32_t num_bytes;    // that follow: text for the CLI, a Body, a start, a folder for the fork
    float rc[8];           // us, AETR + AUX1-4
} request_t;

typedef struct {
    uint32_t arming;       // armingFlags
    uint32_t pid;          // of a fork
    uint32_t num_bytes;    // that follow: text of the CLI, or why it does not arm
    float motor[4];        // us of PWM, Betaflight's order
    float motor_low, motor_high;  // what the mixer may ask for, us
    double p[3], v[3], a[3], q[4], w[3], speed[4], loaded_v;
} reply_t;

typedef struct { double p[3], v[3], q[4], w[3], volt; uint64_t noise; } start_t;

#define PASS_US 10         // virtual time between two passes of the scheduler
#define STEP_US 125        // of the body, STEP_S
#define VREF_V 3.3         // of the ADC
#define ADC_MOST 4095.0
#define DIVIDER 11.0       // of the voltage, as vbat_scale 110 says

static uint64_t now_us = 0, next_us = 0, elapsed_us = 0;
static uint32_t left_us = 0;
static bool running = false, stepping = false, started = false;
static int host = -1;
static request_t request;
static Body body;
static BodyState state;
static double report_v[3];  // velocity and time of the last report
static uint64_t report_us = 0;
static bool rc_pending = false;
static char text[1 << 18];
static uint32_t text_bytes = 0;
static tcpPort_t uart;
static bool uart_open = false;

static void readAll(void *data, size_t size)
{
    for (uint8_t *to = data; size;) {
        ssize_t n = read(host, to, size);
        if (n <= 0) exit(0);  // the host is gone
        to += n; size -= n;
    }
}

static void writeAll(const void *data, size_t size)
{
    for (const uint8_t *from = data; size;) {
        ssize_t n = send(host, from, size, MSG_NOSIGNAL);
        if (n <= 0) exit(0);
        from += n; size -= n;
    }
}

// Read a request; return the file descriptor that came with it, or -1.
static int readRequest(void)
{
    char control[CMSG_SPACE(sizeof(int))];
    struct iovec where = { &request, sizeof(request) };
    struct msghdr message = { .msg_iov = &where, .msg_iovlen = 1, .msg_control = control, .msg_controllen = sizeof(control) };
    ssize_t n = recvmsg(host, &message, 0);
    if (n <= 0) exit(0);
    readAll((uint8_t *)&request + n, sizeof(request) - n);
    struct cmsghdr *header = CMSG_FIRSTHDR(&message);
    int passed = -1;
    if (header && header->cmsg_type == SCM_RIGHTS) memcpy(&passed, CMSG_DATA(header), sizeof(passed));
    return passed;
}

static float readRc(const rxRuntimeState_t *rxState, uint8_t channel)
{
    UNUSED(rxState);
    return channel < 8 ? request.rc[channel] : 1000.0f;
}

static uint8_t rcFrameStatus(rxRuntimeState_t *rxState)
{
    UNUSED(rxState);
    if (!rc_pending) return RX_FRAME_PENDING;
    rc_pending = false;
    return RX_FRAME_COMPLETE;
}

static void receiveFrame(void)
{
    rc_pending = true;
    if (rxRuntimeState.rxProvider != RX_PROVIDER_UDP) {
        rxRuntimeState.channelCount = 8;
        rxRuntimeState.rcReadRawFn = readRc;
        rxRuntimeState.rcFrameStatusFn = rcFrameStatus;
        rxRuntimeState.rxProvider = RX_PROVIDER_UDP;
    }
}

static int16_t counts(double value)
{
    return (int16_t)lrint(value < -32767 ? -32767 : value > 32767 ? 32767 : value);
}

static void sense(void)
{
    const double per_rad = GYRO_SCALE * RAD2DEG;
    double w[3], f[3];
    for (int k = 0; k < 3; k++) {
        w[k] = per_rad * (state.w[k] + (body.gyro_noise > 0 ? body.gyro_noise * body_noise(&state) : 0));
        f[k] = ACC_SCALE * (state.f[k] + (body.acc_noise > 0 ? body.acc_noise * body_noise(&state) : 0));
    }
    virtualGyroSet(virtualGyroDev, counts(w[0]), counts(w[1]), counts(w[2]));
    virtualAccSet(virtualAccDev, counts(f[0]), counts(f[1]), counts(f[2]));
    virtualBaroSet(101325, 2500);
    imuSetAttitudeQuat(state.q[0], state.q[1], state.q[2], state.q[3]);
}

static void explainDisarmed(void)
{
    for (unsigned k = 0; k < ARMING_DISABLE_FLAGS_COUNT; k++) {
        if (getArmingDisableFlags() & (1u << k))
            text_bytes += snprintf(text + text_bytes, sizeof(text) - text_bytes, "%s ", armingDisableFlagNames[k]);
    }
}

static void answer(uint32_t pid)
{
    double since_s = 1e-6 * (now_us - report_us);
    reply_t reply = { .arming = armingFlags, .pid = pid, .motor_low = mixerRuntime.motorOutputLow, .motor_high = mixerRuntime.motorOutputHigh };
    if (request.kind == ASK_FLY && request.rc[4] > 1500 && !ARMING_FLAG(ARMED)) explainDisarmed();
    reply.num_bytes = text_bytes;
    for (int k = 0; k < 3; k++) reply.a[k] = since_s > 0 ? (state.v[k] - report_v[k]) / since_s : 0;
    memcpy(reply.motor, pwmRawPkt.pwm_output_raw, sizeof(reply.motor));
    memcpy(reply.p, state.p, sizeof(state.p));
    memcpy(reply.v, state.v, sizeof(state.v));
    memcpy(reply.q, state.q, sizeof(state.q));
    memcpy(reply.w, state.w, sizeof(state.w));
    memcpy(reply.speed, state.speed, sizeof(state.speed));
    reply.loaded_v = state.loaded_v;
    writeAll(&reply, sizeof(reply));
    if (text_bytes) writeAll(text, text_bytes);
    text_bytes = 0;
    memcpy(report_v, state.v, sizeof(report_v));
    report_us = now_us;
}

static void typeText(uint32_t num_bytes)
{
    for (; num_bytes; num_bytes--) {
        uint8_t byte;
        readAll(&byte, 1);
        uart.rxBuffer[uart.port.rxBufferHead] = byte;
        uart.port.rxBufferHead = (uart.port.rxBufferHead + 1) % RX_BUFFER_SIZE;
    }
}

static void start(void)
{
    start_t at;
    readAll(&at, sizeof(at));
    memcpy(state.p, at.p, sizeof(at.p));
    memcpy(state.v, at.v, sizeof(at.v));
    memcpy(state.q, at.q, sizeof(at.q));
    memcpy(state.w, at.w, sizeof(at.w));
    state.open_v = state.loaded_v = at.volt;
    state.noise = at.noise | 1;
}

// A copy of this process, all of the firmware's state in it, which serves the other end of ``passed``.
static uint32_t forkTo(int passed)
{
    char folder[4096] = "";
    uint32_t size = request.num_bytes < sizeof(folder) - 1 ? request.num_bytes : sizeof(folder) - 1;
    readAll(folder, size);
    pid_t child = fork();
    if (child == 0) {
        close(host);
        host = passed;
        if (chdir(folder)) exit(1);
        return 0;
    }
    close(passed);
    return (uint32_t)child;
}

// Answer the host, and do as it asks until it lets time pass.
static void serve(void)
{
    uint32_t pid = 0;
    while (true) {
        if (started) answer(pid);
        started = true;
        pid = 0;
        int passed = readRequest();
        switch (request.kind) {
        case ASK_CLI:
            typeText(request.num_bytes);
            break;
        case ASK_BODY:
            readAll(&body, sizeof(body));
            state.q[0] = 1;
            continue;
        case ASK_START:
            start();
            continue;
        case ASK_FORK:
            pid = forkTo(passed);
            continue;
        }
        left_us = request.duration_us;
        elapsed_us = 0;
        return;
    }
}

static void step(void)
{
    if (started) body_step(&body, &state, pwmRawPkt.pwm_output_raw, request.is_held);
    if (left_us < STEP_US) serve();
    if (request.frame_us && elapsed_us % request.frame_us == 0) receiveFrame();
    sense();
    left_us -= STEP_US;
    elapsed_us += STEP_US;
    next_us += STEP_US;
}

static void advance(uint32_t us)
{
    while (us--) {
        now_us++;
        if (running && !stepping && now_us >= next_us) {
            stepping = true;
            step();
            stepping = false;
        }
    }
}

uint64_t nanos64_real(void) { return now_us * 1000; }
uint64_t micros64_real(void) { return now_us; }
uint64_t millis64_real(void) { return now_us / 1000; }
uint64_t micros64(void) { return now_us; }
uint64_t millis64(void) { return now_us / 1000; }
uint32_t micros(void) { return (uint32_t)now_us; }
uint32_t millis(void) { return (uint32_t)(now_us / 1000); }
uint32_t getCycleCounter(void) { advance(1); return (uint32_t)now_us; }  // the scheduler polls it
void delayMicroseconds(uint32_t us) { advance(us); }
void delay(uint32_t ms) { advance(1000 * ms); }

void delayMicroseconds_real(uint32_t us)  // main.c, after each pass of the scheduler
{
    UNUSED(us);
    if (!running) {
        running = true;
        next_us = now_us;
    }
    advance(PASS_US);
}

uint16_t adcGetChannel(uint8_t channel)
{
    double share = state.loaded_v / DIVIDER / VREF_V;
    return channel == ADC_BATTERY ? (uint16_t)(ADC_MOST * (share < 0 ? 0 : share > 1 ? 1 : share)) : 0;
}

void systemInit(void)
{
    host = dup(0);
    dup2(2, 1);  // what the firmware prints goes to stderr
    signal(SIGCHLD, SIG_IGN);
    SystemCoreClock = 500 * 1e6;
}

void systemReset(void) { exit(0); }
void systemResetToBootloader(bootloaderRequestType_e type) { UNUSED(type); exit(0); }

// UART1 over the same socket; the others stay closed.
static uint32_t uartWaiting(const serialPort_t *port)
{
    return (RX_BUFFER_SIZE + port->rxBufferHead - port->rxBufferTail) % RX_BUFFER_SIZE;
}
static uint32_t uartFree(const serialPort_t *port) { UNUSED(port); return TX_BUFFER_SIZE - 1; }
static bool uartEmpty(const serialPort_t *port) { UNUSED(port); return true; }
static uint8_t uartRead(serialPort_t *port)
{
    uint8_t byte = uart.rxBuffer[port->rxBufferTail];
    port->rxBufferTail = (port->rxBufferTail + 1) % RX_BUFFER_SIZE;
    return byte;
}
static void uartWrite(serialPort_t *port, uint8_t byte)
{
    UNUSED(port);
    if (text_bytes < sizeof(text)) text[text_bytes++] = byte;
}
static const struct serialPortVTable uartTable = {
    .serialWrite = uartWrite,
    .serialTotalRxWaiting = uartWaiting,
    .serialTotalTxFree = uartFree,
    .serialRead = uartRead,
    .isSerialTransmitBufferEmpty = uartEmpty,
};

serialPort_t *serTcpOpen(serialPortIdentifier_e id, serialReceiveCallbackPtr callback, void *data, uint32_t baudRate, portMode_e mode, portOptions_e options)
{
    if (uart_open) return NULL;
    uart_open = true;
    UNUSED(id);
    uart.port.vTable = &uartTable;
    uart.port.rxBufferSize = RX_BUFFER_SIZE;
    uart.port.txBufferSize = TX_BUFFER_SIZE;
    uart.port.rxBuffer = uart.rxBuffer;
    uart.port.txBuffer = uart.txBuffer;
    uart.port.rxCallback = callback;
    uart.port.rxCallbackData = data;
    uart.port.mode = mode;
    uart.port.baudRate = baudRate;
    uart.port.options = options;
    return &uart.port;
}
